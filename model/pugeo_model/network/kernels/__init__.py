# SPDX-License-Identifier: Apache-2.0
"""Compiled (numba) kernels of the network; a test compares each with its definition in torch."""
