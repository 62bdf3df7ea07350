# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with an input.

CloudError
|- MalformedFileError        the bytes are not what they claim to be
|- UnsupportedFormatError    no reader or writer of that name or content
|- LimitExceededError        larger than the stated limit
|- UntreatableCloudError     a valid file whose points the method cannot treat
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
    """An input that cannot be used, with words for a person and fields for a program.

    Args:
        message: one or two sentences: what is wrong, where, and what would be right.
        code: a stable slug such as ``"truncated"``; the class's own name by default.
        fields: values behind the message (``limit=1000, value=4000000000``), JSON-able.
    """

    code = "cloud_error"

    def __init__(self, message: str, *, code: str | None = None, **fields: Any) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or type(self).code
        self.fields = fields

    def __reduce__(self) -> tuple[Any, ...]:
        # Errors cross process borders; keyword arguments do not survive pickle's default way.
        return _rebuild, (type(self), self.message, self.code, self.fields)


class MalformedFileError(CloudError):
    """The bytes break the rules of their own format."""

    code = "malformed_file"


class UnsupportedFormatError(CloudError):
    """No reader or writer for this content or name."""

    code = "unsupported_format"


class LimitExceededError(CloudError):
    """Larger than a stated limit; ``fields`` name it, its bound and the value met."""

    code = "limit_exceeded"


class UntreatableCloudError(CloudError):
    """The file is well formed, but its points span no surface (too few, all on one line)."""

    code = "untreatable_cloud"


class BadOptionError(CloudError):
    """An option outside its range; ``fields`` name it."""

    code = "bad_option"


def _rebuild(kind: type[CloudError], message: str, code: str, fields: dict[str, Any]) -> CloudError:
    return kind(message, code=code, **fields)
