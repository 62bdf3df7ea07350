# SPDX-License-Identifier: Apache-2.0
"""Linear layers with a fused product, bias and ReLU for inference.

In bfloat16 torch writes the bias into the result, adds the product and applies the ReLU in three
passes; bias and ReLU take a fifth and a tenth of the time of the network. oneDNN does all in one
pass by the operator used here, which torch's compiler uses too.
"""

from typing import Any

import torch
from torch import Tensor, nn

from pugeo_model.network.kernels.pooling import rectify
from pugeo_model.network.precision import bfloat16_pays

__all__ = ["Linear", "Rectified", "freeze"]

# A private operator of torch, which may be absent in a version or on a processor.
_product = getattr(torch.ops.mkldnn, "_linear_pointwise", None)


class Linear(nn.Linear):
    """Linear layer ``x A^T + b``; fused if it is frozen and no gradient is needed.

    Attributes:
        activation: activation of the fused operator.
        frozen: weight and bias in bfloat16, set by `freeze`.
    """

    activation = "none"
    frozen: tuple[Tensor, Tensor | None] | None = None

    def forward(self, rows: Tensor) -> Tensor:
        """``(..., in_features)`` -> ``(..., out_features)``."""
        if self.frozen is None or torch.is_grad_enabled():
            return self._unfused(rows)
        assert _product is not None
        result: Tensor = _product(rows.to(torch.bfloat16), *self.frozen, self.activation, [], "")
        return result

    def _unfused(self, rows: Tensor) -> Tensor:
        """Torch's own layer, for gradients and where the fused operator is absent."""
        return super().forward(rows)


class Rectified(Linear):
    """Linear layer followed by a ReLU."""

    activation = "relu"

    def _unfused(self, rows: Tensor) -> Tensor:
        return rectify(super()._unfused(rows))


def freeze(net: nn.Module) -> None:
    """Round the weights of all linear layers to bfloat16 for inference, if that is faster.

    Later changes of the weights have no effect on inference.
    """
    if not (bfloat16_pays() and _fused_product_works()):
        return
    for layer in net.modules():
        if isinstance(layer, Linear):
            layer.frozen = _rounded(layer.weight), _rounded(layer.bias)


def _fused_product_works() -> bool:
    """Try the fused operator."""
    if _product is None:
        return False
    matrix = torch.ones(8, 8, dtype=torch.bfloat16)
    try:
        with torch.inference_mode():
            _product(matrix, matrix, matrix[0], "relu", [], "")
    except RuntimeError:  # the base class of torch's errors of missing kernels
        return False
    return True


def _rounded(values: Any) -> Any:
    return None if values is None else values.detach().to(torch.bfloat16)
