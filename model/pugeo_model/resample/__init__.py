# SPDX-License-Identifier: Apache-2.0
"""From candidates of all charts to exactly the points wanted, evenly spread. No torch."""
