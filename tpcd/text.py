"""Text files of any encoding, of which a few lines show what they are.

UTF-8, 16 and 32 are known by their marks, UTF-16 without one by its zeros, and what is no UTF-8 is
taken for the encoding of Western Europe.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path

HEAD, TAIL = 1 << 18, 1 << 16
"""Bytes at either end that show the layout."""


def encoding_of(path: Path) -> str:
    """The encoding of a text file: by its mark, by zeros, or by whether all of it is UTF-8."""
    with path.open("rb") as file:
        head = file.read(1000)
        for mark, encoding in (
            (codecs.BOM_UTF8, "utf-8-sig"),
            (codecs.BOM_UTF32_LE, "utf-32"),
            (codecs.BOM_UTF16_LE, "utf-16"),
            (codecs.BOM_UTF16_BE, "utf-16"),
        ):
            if head.startswith(mark):
                return encoding
        for encoding, zeros in (("utf-16-le", head[1::2]), ("utf-16-be", head[::2])):
            if zeros and 2 * zeros.count(0) > len(zeros):
                return encoding
        decoder = codecs.getincrementaldecoder("utf-8")()
        try:
            decoder.decode(head)
            while part := file.read(1 << 20):
                decoder.decode(part)
            decoder.decode(b"", final=True)
        except UnicodeDecodeError:
            return "cp1252"
    return "utf-8"


def read_ends(path: Path, encoding: str) -> tuple[str, str]:
    """The beginning of a text file, and the end of one that is longer."""
    with path.open("rb") as file:
        head = file.read(HEAD)
        size = file.seek(0, 2)
        if size <= HEAD:
            return head.decode(encoding, "replace" if encoding == "cp1252" else "strict"), ""
        wide = 4 if "32" in encoding else 2
        file.seek(max(HEAD, size - TAIL) // wide * wide)
        tail = file.read()
    bare = encoding if encoding[-2:] in ("le", "be") or "16" not in encoding else "utf-16-le"
    if encoding == "utf-16" and head.startswith(codecs.BOM_UTF16_BE):
        bare = "utf-16-be"
    bare = "utf-32-le" if encoding == "utf-32" else bare
    return head.decode(encoding, "replace"), tail.decode(bare, "replace")


def read_text(path: Path, encoding: str) -> str:
    """All of a text file, with a line feed at the end of each line."""
    errors = "replace" if encoding == "cp1252" else "strict"
    with path.open(encoding=encoding, errors=errors) as file:
        return file.read()


def lines_of(text: str) -> list[str]:
    """The lines of a text, whatever ends them."""
    return re.split("\r\n|\n|\r", text)
