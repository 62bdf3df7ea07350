# SPDX-License-Identifier: Apache-2.0
"""Compiled (numba) kernels of the network, each held by a test to the plain torch rule beside it."""
