# SPDX-License-Identifier: Apache-2.0
"""The HTTP service: FastAPI in front, worker processes behind. The front never imports torch."""

__version__ = "0.1.0"
__all__ = ["__version__"]
