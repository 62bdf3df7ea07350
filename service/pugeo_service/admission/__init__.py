# SPDX-License-Identifier: Apache-2.0
"""Admission control: the bounded queue, fair shares, measured throughput, deadlines."""
