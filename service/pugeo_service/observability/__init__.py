# SPDX-License-Identifier: Apache-2.0
"""Logs, Prometheus metrics and OpenTelemetry traces."""
