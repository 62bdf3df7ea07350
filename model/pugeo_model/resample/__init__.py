# SPDX-License-Identifier: Apache-2.0
"""Selection of exactly the requested number of evenly distributed points. No torch."""
