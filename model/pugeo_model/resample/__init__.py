# SPDX-License-Identifier: Apache-2.0
"""From predicted points to the output points."""
