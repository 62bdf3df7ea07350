# SPDX-License-Identifier: Apache-2.0
"""Pages of E57 files: 1,020 bytes of content and a CRC-32C of them, big endian."""

import functools

__all__ = ["pack", "unpack"]

_PAGE, _CONTENT = 1024, 1020
_POLYNOMIAL = 0x82F63B78  # CRC-32C (Castagnoli), reflected


def unpack(data: bytes) -> bytes:
    """The content of all pages."""
    return b"".join(data[at : at + _PAGE][:_CONTENT] for at in range(0, len(data), _PAGE))


def pack(content: bytes) -> bytes:
    """Pages with right checksums; the last one is filled with zeros."""
    pages = []
    for at in range(0, len(content), _CONTENT):
        page = content[at : at + _CONTENT].ljust(_CONTENT, b"\0")
        pages.append(page + _crc(page).to_bytes(4, "big"))
    return b"".join(pages)


@functools.cache
def _table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (_POLYNOMIAL if value & 1 else 0)
        table.append(value)
    return table


@functools.lru_cache(maxsize=4096)
def _crc(page: bytes) -> int:
    table, crc = _table(), 0xFFFFFFFF
    for byte in page:
        crc = crc >> 8 ^ table[(crc ^ byte) & 255]
    return crc ^ 0xFFFFFFFF
