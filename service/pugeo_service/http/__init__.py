# SPDX-License-Identifier: Apache-2.0
"""HTTP: parsing limits, authentication, bodies, content negotiation, responses, OpenAPI."""
