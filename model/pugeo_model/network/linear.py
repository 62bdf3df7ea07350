# SPDX-License-Identifier: Apache-2.0
"""Linear layers that take one pass where torch takes three, once they freeze.

In bfloat16 torch first writes the bias into every row of the result, then adds the product to it,
and rectifies in a pass of its own: a fifth of the network's time, and a tenth. oneDNN does all
three as the product leaves its registers. Torch's compiler calls it by the operator used here.
"""

from typing import Any

import torch
from torch import Tensor, nn

from pugeo_model.network.kernels.pooling import rectify
from pugeo_model.network.precision import bfloat16_pays

__all__ = ["Linear", "Rectified", "freeze"]

# Torch's own, not its interface: a version or a processor may be without it.
_product = getattr(torch.ops.mkldnn, "_linear_pointwise", None)


class Linear(nn.Linear):
    """``x A^T + b``, like torch's own while a gradient is wanted."""

    after = "none"
    served: tuple[Tensor, Tensor | None] | None = None

    def forward(self, rows: Tensor) -> Tensor:
        """``(..., in_features)`` -> ``(..., out_features)``."""
        if self.served is None or torch.is_grad_enabled():
            return self._trained(rows)
        assert _product is not None
        result: Tensor = _product(rows.to(torch.bfloat16), *self.served, self.after, [], "")
        return result

    def _trained(self, rows: Tensor) -> Tensor:
        """Torch's three passes: with gradients, and where the one pass is not to be had."""
        return super().forward(rows)


class Rectified(Linear):
    """A linear layer with a ReLU behind it."""

    after = "relu"

    def _trained(self, rows: Tensor) -> Tensor:
        return rectify(super()._trained(rows))


def freeze(net: nn.Module) -> None:
    """Round the weights of all layers to bfloat16, where it pays, once and not in every call.

    From then on, without gradients, they are taken as they are now.
    """
    if not (bfloat16_pays() and _there()):
        return
    for layer in net.modules():
        if isinstance(layer, Linear):
            layer.served = _rounded(layer.weight), _rounded(layer.bias)


def _there() -> bool:
    """Whether the operator is there and works, by trying it."""
    if _product is None:
        return False
    some = torch.ones(8, 8, dtype=torch.bfloat16)
    try:
        with torch.inference_mode():
            _product(some, some, some[0], "relu", [], "")
    except RuntimeError:  # which torch's errors of missing kernels are, too
        return False
    return True


def _rounded(values: Any) -> Any:
    return None if values is None else values.detach().to(torch.bfloat16)
