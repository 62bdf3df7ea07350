# SPDX-License-Identifier: Apache-2.0
"""The version of the distribution, where reading it costs nothing."""

__version__ = "0.1.0"
