# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from pugeo_model.network.kernels.pooling import pools, sums

STOPS = (3, 5, 12)


@pytest.fixture
def drawn():
    """Outputs of a ReLU for 12 neighbours of 50 points, with many zeros and ties."""
    torch.manual_seed(0)
    return (torch.randperm(12 * 400).reshape(12, 50, 8).remainder(240) - 40.0).relu()


def plain(values, stops):
    tops = [values[:stop].max(dim=0).values for stop in stops]
    return torch.cat([*tops, values.mean(dim=0)], dim=-1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("turned", [False, True], ids=["contiguous", "transposed"])
def test_pools_match_torch(drawn, dtype, turned):
    """Values and gradients equal those of torch, also for non-contiguous inputs."""
    drawn = drawn.to(dtype)
    values = (drawn.mT.contiguous().mT if turned else drawn.clone()).requires_grad_()
    other = drawn.clone().requires_grad_()
    torch.testing.assert_close(pools(values, STOPS), plain(other, STOPS))
    weight = torch.rand(50, 32).to(dtype)
    (weight * pools(values, STOPS)).sum().backward()
    (weight * plain(other, STOPS)).sum().backward()
    single = other.detach() > 0
    for stop in STOPS:
        top = other.detach()[:stop].amax(dim=0)
        single &= (other.detach() == top).sum(dim=0) <= 1
    assert single.float().mean() > 0.5
    assert values.grad is not None
    assert other.grad is not None
    torch.testing.assert_close(values.grad[single], other.grad[single])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_pools_without_a_gradient(drawn, dtype):
    """The compiled kernel equals the definition, after the leading columns."""
    drawn = drawn.to(dtype)
    before = torch.rand(50, 3).to(dtype)
    with torch.inference_mode():
        found = pools(drawn, STOPS, before)
    assert found.dtype == dtype
    torch.testing.assert_close(found, torch.cat([before, pools(drawn, STOPS)], dim=-1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_sums_match_torch(dtype):
    """Each edge is the rectified sum of its own, its sender's and its receiver's part."""
    torch.manual_seed(0)
    edges, sent, own = (torch.randn(*s).to(dtype) for s in ((4, 50, 8), (70, 8), (50, 8)))
    sources = torch.randint(70, (4, 50))
    wanted = (edges.double() + sent.double()[sources] + own.double()).relu()
    assert 0.3 < (wanted > 0).float().mean() < 0.7
    plain_sums = sums(edges.clone().requires_grad_().clone(), sent, sources, own)
    with torch.inference_mode():
        compiled = sums(edges.clone(), sent, sources, own)
    # Torch rounds between the sums as well.
    torch.testing.assert_close(plain_sums.double(), wanted, rtol=0.02, atol=0.02)
    torch.testing.assert_close(compiled, wanted.to(dtype))
