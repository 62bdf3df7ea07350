# SPDX-License-Identifier: Apache-2.0
"""The tables and figures of the paper, measured anew: `pugeo reproduce` writes docs/paper.md."""
