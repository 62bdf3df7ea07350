# SPDX-License-Identifier: Apache-2.0
"""Ways to break a file: blind ones, and ones that know where a format keeps its promises."""

import copy
import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.reliability import e57_pages
from benchmarks.reliability.corpus import pack

__all__ = ["Mutator"]

_Random = random.Random
Change = Callable[[_Random, bytes], bytes]

_INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_WIDER = (0x7FFFFFFFFFFFFFFF, 0x8000000000000000, 0xFFFFFFFFFFFFFFFF, 1 << 40, (1 << 40) + 1)
_NUMBERS = (
    b"-1 0 00 1 2 3 255 256 65536 4294967295 4294967296 18446744073709551616 999999999999999999 "
    b"9007199254740993 1e400 -1e400 1e-400 1e38 1e39 1e308 1e999999999 nan -nan inf -Infinity NaN "
    b"0x10 1_0 1. .5 - + . e 1e 1,5 --1 1-2 true null 4000000000 100000 0.1e1 5e-324"
).split() + [b"", b"\xd9\xa1", b"\xff", b"9" * 400, b"0." + b"3" * 5000, b'"7"', b"[]", b"{}"]
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 0.5, 255, 256, 1e39, 1e308, 2**53, 2**63, 2**64, 10**30, -(2**70)),
    *("", "1", "a" * 1000, [], {}, [1, 2], [1, 2, 3], [1, 2, 3, 4], [[1, 2, 3]], {"a": [1]}),
    *(
        float("nan"),
        float("inf"),
        [None] * 9,
        [True] * 9,
        [0.25] * 9,
        [2**65] * 9,
        [[0, 0, 1.5]] * 9,
    ),
)
_WORDS = {
    "ply": (
        b"ply,format,ascii,binary_little_endian,binary_big_endian,1.0,element,property,list,"
        b"vertex,face,char,uchar,short,ushort,int,uint,int64,uint64,float,double,float16,x,y,z,nx,"
        b"red,green,blue,alpha,diffuse_red,comment,obj_info,end_header,f_dc_0,opacity,\r,\n,\r\n, "
    ).split(b","),
    "npy": (
        b"'descr':|'fortran_order':|'shape':|True|False|'|O'|'<f4'|'>f8'|'<f16'|'<c8'|'<U5'|'|S3'|"
        b"'<M8[s]'|'|V9'|'|b1'|'<i8'|[('a', '<f4')]|'f4,f4'|(3,)|(0, 3)|(9, 3)|(9, 6)|(-9, 3)|"
        b"(99999999, 3)|(9223372036854775807, 3)|(9, 3, 1)|()|(9.0, 3)|(None, 3)|{|}|(|)|,| |"
        b"__import__('os')|9**9**9|'x'*10**9|\x93NUMPY|\x00"
    ).split(b"|"),
    "json": (
        b'"points":\n"normals":\n"colors":\n"scalars":\n"other":\n[\n]\n{\n}\n,\n:\nnull\ntrue\n'
        b'false\n""\n"a"\n"\\ud800"\n"\\u0000"\n[[1,2,3]]\n[[1,2]]\n[]\n{}\n\xef\xbb\xbf\n\xff\n\\'
    ).split(b"\n"),
    "xyz": b"x y z nx ny nz red green blue c3 # // , ; \r \n \t \x00 \x0b \xc2\xa0 1;2;3".split(
        b" "
    ),
}
_WORDS |= {
    "las": b"LASF|LASF_Spec|LASF_Projection|laszip encoded|\xff\xff|\x00".split(b"|"),
    "pcd": (
        b"VERSION|FIELDS|SIZE|TYPE|COUNT|WIDTH|HEIGHT|VIEWPOINT|POINTS|DATA|ascii|binary|"
        b"binary_compressed| x| y| z| rgb| rgba| normal_x| _| F| U| I| 8| 4| 3|nan|\n|#"
    ).split(b"|"),
    "ptx": b"0 0 0 0.5|1 0 0 0|1 0 0|nan|inf|\n|\r\n| |-1|1e400|4\n2\n".split(b"|"),
    "obj": b"v |vn |vt |f |o |# |/|1/1/1|nan|\n|\r|mtllib a.mtl|0.5 0.5 0.5".split(b"|"),
    "stl": b"solid|endsolid|facet|normal|outer loop|endloop|endfacet|vertex|nan|\n|1e40".split(
        b"|"
    ),
    "e57": (
        b"data3D|points|prototype|cartesianX|sphericalRange|intensity|colorRed|nor:normalX|pose|"
        b"rotation|translation|Integer|ScaledInteger|Float|Structure|Vector|CompressedVector|Blob|"
        b"String|recordCount|fileOffset|minimum|maximum|scale|precision|single|double|type|</|/>|"
        b'<|>|"|&lt;|childCount|<?xml|]]>|codecs|cartesianInvalidState'
    ).split(b"|"),
}
_WORDS["laz"] = _WORDS["las"]
# Numbers of a LAS header: offset and width; then those of a record, from its own beginning.
_LAS_FIELDS = [
    *[(24, 1), (25, 1), (94, 2), (96, 4), (100, 4), (104, 1), (105, 2), (107, 4), (111, 4)],
    *[(131, 8), (155, 8), (179, 8), (227, 8), (235, 8), (243, 4), (247, 8), (6, 2)],
]
_WORDS["npz"] = [*_WORDS["npy"], b"points.npy", b"normals.npy", b"colors.npy", b"/", b"../x.npy"]
# Where a zip archive's records keep their numbers: offset from the signature, and width.
_ZIP_FIELDS = {
    b"PK\x03\x04": [(4, 2), (6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2)],
    b"PK\x01\x02": [
        *[(6, 2), (8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (34, 2)],
        *[(38, 4), (42, 4)],
    ],
    b"PK\x05\x06": [(4, 2), (6, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2)],
}
# The last one is no method that numpy writes.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
_MOST_BYTES = 4_000_000


class Mutator:
    """Makes broken files out of valid ones.

    Args:
        files: valid files by the name of their format.
        kinds: formats to make broken files of; all where empty.
    """

    def __init__(self, files: dict[str, list[bytes]], kinds: Sequence[str] = ()) -> None:
        self._kinds = list(kinds or files)
        # A file of a megabyte costs as much time as a thousand small ones.
        self._small = {kind: [f for f in each if len(f) < 10_000] for kind, each in files.items()}
        self._large = {kind: [f for f in each if len(f) >= 10_000] for kind, each in files.items()}

    def make(self, rng: _Random) -> tuple[str, bytes]:
        """One broken file and the format that it was made from; ``rng`` decides everything."""
        kind = rng.choice(self._kinds)
        large = self._large[kind] if rng.random() < 0.002 else []
        data = rng.choice(large or self._small[kind])
        for _ in range(rng.choice((1, 1, 1, 1, 2, 2, 3, 6))):
            data = self._change(rng, kind)(rng, data)[:_MOST_BYTES]
        return kind, data

    def _change(self, rng: _Random, kind: str) -> Change:
        if rng.random() < 0.5:
            known: Sequence[Change] = _KNOWING[kind]
            return rng.choice([*known, lambda r, data: _insert(r, data, r.choice(_WORDS[kind]))])
        return rng.choice([*_BLIND, self._splice])

    def _splice(self, rng: _Random, data: bytes) -> bytes:
        """The beginning of one file and the end of another."""
        other = rng.choice(self._small[rng.choice(self._kinds)])
        return data[: _place(rng, data)] + other[_place(rng, other) :]


def _place(rng: _Random, data: bytes) -> int:
    return rng.randrange(len(data) + 1)


def _insert(rng: _Random, data: bytes, new: bytes) -> bytes:
    """Put ``new`` somewhere, over as many bytes or between them."""
    at = _place(rng, data)
    return data[:at] + new + data[at + rng.choice((0, len(new))) :]


def _truncate(rng: _Random, data: bytes) -> bytes:
    return data[: _place(rng, data)]


def _flip(rng: _Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(min(len(changed), rng.choice((1, 1, 2, 4, 16)))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _integer(rng: _Random, data: bytes) -> bytes:
    """An extreme whole number of one to eight bytes, in either order."""
    width = rng.choice((1, 2, 4, 8))
    value = rng.choice(_INTEGERS + _WIDER) & ((1 << 8 * width) - 1)
    at = _place(rng, data)
    return data[:at] + value.to_bytes(width, rng.choice(("little", "big"))) + data[at + width :]


def _float(rng: _Random, data: bytes) -> bytes:
    value = rng.choice((0.0, -0.0, 1e38, 3.5e38, 1e308, -1e308, 5e-324, float("nan"), float("inf")))
    packed = struct.pack(rng.choice("<>") + "d", value)
    at = _place(rng, data)
    return data[:at] + packed + data[at + len(packed) :]


def _block(rng: _Random, data: bytes) -> bytes:
    """Repeat, remove or move a piece."""
    begin = _place(rng, data)
    end = min(len(data), begin + rng.choice((1, 4, 12, 100, 1000)))
    piece, rest = data[begin:end], data[:begin] + data[end:]
    at = _place(rng, rest)
    return rng.choice(
        (
            rest,
            data[:end] + piece * rng.choice((1, 2, 50)) + data[end:],
            rest[:at] + piece + rest[at:],
        )
    )


def _number(rng: _Random, data: bytes) -> bytes:
    """Replace a number that is written out."""
    # Headers stand first, and in a large file the rest is all alike.
    found = list(_NUMBER.finditer(data, 0, 4000))
    if not found:
        return _integer(rng, data)
    one = rng.choice(found)
    return data[: one.start()] + rng.choice(_NUMBERS) + data[one.end() :]


def _line(rng: _Random, data: bytes) -> bytes:
    """Remove, repeat, swap or join lines of the first few thousand bytes."""
    head, tail = data[:4000], data[4000:]
    lines = head.split(b"\n")
    one, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[one]
        case 1:
            lines.insert(other, lines[one])
        case 2:
            lines[one], lines[other] = lines[other], lines[one]
        case _:
            lines[one] = lines[one] + b" " + lines[other]
    return b"\n".join(lines) + tail


def _word(kind: str) -> Change:
    def change(rng: _Random, data: bytes) -> bytes:
        """Put a word of the format in place of one that is there."""
        words = [word for word in _WORDS[kind] if len(word) > 1 and word in data[:4000]]
        if not words:
            return _insert(rng, data, rng.choice(_WORDS[kind]))
        old = rng.choice(words)
        times = rng.choice((1, 1, 1, -1))
        return data.replace(old, rng.choice(_WORDS[kind]), times)

    return change


def _value(rng: _Random, data: bytes) -> bytes:
    """Change a value of a document that stays JSON."""
    try:
        document = json.loads(data) if len(data) < 20_000 else None
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or not document:
        return _number(rng, data)
    # Down to something small: a key of the document, a row, a coordinate.
    parent, key = document, rng.choice(list(document))
    while rng.random() < 0.7 and isinstance(parent[key], dict | list) and parent[key]:
        parent = parent[key]
        key = rng.choice(list(parent)) if isinstance(parent, dict) else rng.randrange(len(parent))
    new = copy.deepcopy(rng.choice((*_VALUES, parent[key], [parent[key]], document.get("points"))))
    match rng.randrange(4):
        case 0:
            del parent[key]
        case 1 if isinstance(parent, list):
            parent.insert(key, new)
        case 1:
            parent[rng.choice(("points", "normals", "colors", "scalars", "x", ""))] = new
        case _:
            parent[key] = new
    return json.dumps(document).encode()


def _nest(rng: _Random, data: bytes) -> bytes:
    """Brackets within brackets."""
    depth = rng.choice((3, 100, 1100, 20_000))
    opening, closing = rng.choice(((b"[", b"]"), (b'{"a":', b"}"), (b"(", b")")))
    at = _place(rng, data)
    return data[:at] + opening * depth + closing * rng.choice((0, depth)) + data[at:]


def _array_header(rng: _Random, data: bytes) -> bytes:
    """Lie about version or length of an array's header."""
    changed = bytearray(data)
    at = changed.find(b"\x93NUMPY")
    if at < 0 or len(changed) < at + 12:
        return _flip(rng, data)
    if rng.random() < 0.4:
        changed[at + 6 : at + 8] = rng.choice(
            (b"\1\0", b"\2\0", b"\3\0", b"\4\0", b"\0\0", b"\1\1")
        )
    else:
        changed[at + 8 : at + 10] = rng.choice(_INTEGERS[:9]).to_bytes(2, "little")
    return bytes(changed)


def _zip_field(rng: _Random, data: bytes) -> bytes:
    """Lie in one of the numbers of an archive's records."""
    signature = rng.choice(list(_ZIP_FIELDS))
    places = [found.start() for found in re.finditer(re.escape(signature), data)]
    if not places:
        return _flip(rng, data)
    offset, width = rng.choice(_ZIP_FIELDS[signature])
    at = rng.choice(places) + offset
    value = rng.choice((*_INTEGERS, 8, 12, 14, 95, 99, len(data), len(data) - 1)) & (
        (1 << 8 * width) - 1
    )
    return data[:at] + value.to_bytes(width, "little") + data[at + width :]


def _zip_member(rng: _Random, data: bytes) -> bytes:
    """Break an array inside of an archive whose own checksums stay right."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {
                entry.filename: archive.read(entry)
                for entry in archive.infolist()
                if entry.file_size < 1 << 20
            }
    except Exception:  # noqa: BLE001 - an earlier change broke it, however zipfile puts that
        return _zip_field(rng, data)
    if not members:
        return _zip_field(rng, data)
    name = rng.choice(list(members))
    changes: Sequence[Change] = (_array_header, _number, _word("npy"), _flip, _truncate, _integer)
    members[name] = rng.choice(changes)(rng, members[name])
    if rng.random() < 0.3:
        members[rng.choice(("points.npy", "class.npy", "x" * 300, "é.npy", "a/b.npy", ""))] = (
            members.pop(name)
        )
    return pack(members, rng.choice(_METHODS))


def _bomb(rng: _Random, _data: bytes) -> bytes:
    """A small archive that unpacks to a lot, honest or not about how much."""
    rows = rng.choice((100_000, 400_000))
    shape = rng.choice((f"({rows}, 3)", "(9, 3)", f"({rows * 100}, 3)"))
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    member = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode()
    return pack({"points.npy": member + bytes(12 * rows)}, zipfile.ZIP_DEFLATED)


def _las_field(rng: _Random, data: bytes) -> bytes:
    """Lie in one of the numbers of a LAS header, or in the first bytes behind it."""
    offset, width = rng.choice([*_LAS_FIELDS, (rng.randrange(227, 700), rng.choice((2, 4, 8)))])
    if offset + width > len(data):
        return _flip(rng, data)
    old = int.from_bytes(data[offset : offset + width], "little")
    chosen = (*_INTEGERS, *_WIDER, len(data), old + 1, old - 1, 2 * old, old ^ 128)
    value = rng.choice(chosen) & ((1 << 8 * width) - 1)
    return data[:offset] + value.to_bytes(width, "little") + data[offset + width :]


def _laz_table(rng: _Random, data: bytes) -> bytes:
    """Lie about where the table of chunks is, or how many there are."""
    start = int.from_bytes(data[96:100], "little")
    if start + 8 > len(data):
        return _las_field(rng, data)
    place = int.from_bytes(data[start : start + 8], "little", signed=True)
    at, width = rng.choice(((start, 8), (place, 4), (place + 4, 4), (len(data) - 8, 8)))
    if not 0 <= at <= len(data) - width:
        return _flip(rng, data)
    value = rng.choice((*_INTEGERS, *_WIDER, place, len(data))) & ((1 << 8 * width) - 1)
    return data[:at] + value.to_bytes(width, "little") + data[at + width :]


def _e57_content(rng: _Random, data: bytes) -> bytes:
    """Break an E57 file whose checksums stay right: its XML, its header, its packets."""
    content = e57_pages.unpack(data)
    begin = content.find(b"<?xml")
    if begin < 0 or rng.random() < 0.3:
        changes: Sequence[Change] = (_flip, _integer, _truncate, _block)
        return e57_pages.pack(rng.choice(changes)(rng, content))
    # The XML keeps its place and length as far as spaces can stand in.
    xml, tail = content[begin:].rstrip(b"\0"), b""
    knowing: Sequence[Change] = (_xml_number, _xml_number, _word("e57"), _line, _flip, _block)
    new = rng.choice(knowing)(rng, xml)
    if rng.random() < 0.9:
        new = new[: len(xml)].ljust(len(xml))
    return e57_pages.pack(content[:begin] + new + tail)


def _xml_number(rng: _Random, data: bytes) -> bytes:
    """Replace a number anywhere in a text."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return _flip(rng, data)
    one = rng.choice(found)
    new = rng.choice(_NUMBERS)
    if len(new) > 40:
        new = new[:40]
    return data[: one.start()] + new + data[one.end() :]


_BLIND: tuple[Change, ...] = (_truncate, _flip, _flip, _integer, _float, _block)
_KNOWING: dict[str, tuple[Change, ...]] = {
    "ply": (_number, _number, _line, _line, _word("ply"), _word("ply")),
    "npy": (_number, _array_header, _word("npy"), _word("npy")),
    "npz": (_zip_field, _zip_field, _zip_member, _zip_member, _word("npz")) * 4 + (_bomb,),
    "json": (_number, _value, _value, _value, _nest, _word("json"), _line),
    "xyz": (_number, _number, _line, _word("xyz")),
    "las": (_las_field, _las_field, _las_field, _word("las")),
    "laz": (_las_field, _las_field, _laz_table, _laz_table, _word("laz")),
    "pcd": (_number, _number, _line, _line, _word("pcd"), _word("pcd")),
    "ptx": (_number, _number, _line, _word("ptx")),
    "obj": (_number, _line, _word("obj")),
    "stl": (_number, _line, _word("stl")),
    "e57": (_e57_content,),
}
