# SPDX-License-Identifier: Apache-2.0
"""Routes; each module has a ``router``."""
