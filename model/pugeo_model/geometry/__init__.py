# SPDX-License-Identifier: Apache-2.0
"""Neighbours, local frames and the patches the network works on. numpy and numba, no torch."""
