# SPDX-License-Identifier: Apache-2.0
"""Buffers and files on the disk of the front."""
