# SPDX-License-Identifier: Apache-2.0
"""Shows that the service does not fall over: ``python -m benchmarks.reliability --help``.

Each harness prints a table, writes its figures as JSON, and ends with status 1 where what
docs/reliability.md claims does not hold.
"""
