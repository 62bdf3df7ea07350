# SPDX-License-Identifier: Apache-2.0
"""Temporary and durable files of the front process."""
