# SPDX-License-Identifier: Apache-2.0
"""Errors of bad input: files, points and options.

CloudError
|- MalformedFileError        bytes that break the rules of their format
|- UnsupportedFormatError    no reader or writer of that name or content
|- LimitExceededError        larger than the stated limit
|- UntreatableCloudError     a valid file with points that span no surface
`- BadOptionError            an option out of its range
"""

from typing import Any

__all__ = [
    "BadOptionError",
    "CloudError",
    "LimitExceededError",
    "MalformedFileError",
    "UnsupportedFormatError",
    "UntreatableCloudError",
]


class CloudError(ValueError):
    """Base class of all errors of bad input.

    Args:
        message: one or two sentences: the fault, its place, and a valid alternative.
        code: a stable slug such as ``"truncated"``; by default that of the class.
        fields: values behind the message (``limit=1000, value=4000000000``), JSON-able.
    """

    code = "cloud_error"

    def __init__(self, message: str, *, code: str | None = None, **fields: Any) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or type(self).code
        self.fields = fields

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors are pickled between processes; the default would lose the keyword arguments.
        return _rebuild, (type(self), self.message, self.code, self.fields)


class MalformedFileError(CloudError):
    """The bytes break the rules of their own format."""

    code = "malformed_file"


class UnsupportedFormatError(CloudError):
    """No reader or writer for this content or name."""

    code = "unsupported_format"


class LimitExceededError(CloudError):
    """Input larger than a stated limit; ``fields`` hold its name, the limit and the value."""

    code = "limit_exceeded"


class UntreatableCloudError(CloudError):
    """The file is well formed, but its points span no surface (too few, all on one line)."""

    code = "untreatable_cloud"


class BadOptionError(CloudError):
    """An option outside its range; ``fields`` hold its name and value."""

    code = "bad_option"


def _rebuild(kind: type[CloudError], message: str, code: str, fields: dict[str, Any]) -> CloudError:
    return kind(message, code=code, **fields)
