"""Downloads that survive a broken line: resumed, retried, checked, never half there.

Bytes go to `TARGET.part` with a note of the server's ETag beside it. A later call goes on
where the last one stopped, if the server still offers the same file (HTTP `Range` with
`If-Range`, RFC 9110 sections 13 and 14), and starts again if not. The target appears only
once it is complete and its checksums hold.
"""

from __future__ import annotations

import hashlib
import http.client
import math
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tpcd.errors import FileError
from tpcd.files import named

BLOCK = 1 << 16
UPLOAD_PART = 8 << 20
"""Part size of objects uploaded to S3 by its command line client [bytes]."""
CHECK_CONNECTION = "check the connection and the address, then run this again: it resumes"


@dataclass(frozen=True)
class Patience:
    """How long to insist on a download."""

    attempts: int = 5
    """Tries before giving up; one that brought new bytes does not count."""
    wait_s: float = 1.0
    """Pause before the second try [s]; doubles with each further one."""
    timeout_s: float = 30.0
    """Silence of the server that ends a try [s]."""


class _Interrupted(Exception):
    """This try failed; the next may go on from where it stopped."""


def download(
    url: str,
    target: str | Path,
    *,
    sha256: str | None = None,
    etag_is_digest: bool = False,
    patience: Patience | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> str:
    """Fetch a URL into a file and return the SHA-256 of its content.

    Args:
        sha256: checksum the content must have.
        etag_is_digest: the server's ETags are made of MD5 digests as Amazon S3 makes them;
            check the content against its ETag.
        progress: called with the bytes there are and the bytes there will be (or None).

    Raises:
        FileError: the server refuses, cannot be reached, breaks off again and again, or the
            content does not have its checksum. What is not worth resuming is deleted.
    """
    if not re.match(r"https?://", url):
        raise ValueError(f"url must start with http:// or https://, got {url!r}")
    target = Path(target)
    patience = patience or Patience()
    target.parent.mkdir(parents=True, exist_ok=True)
    part, note = target.with_name(target.name + ".part"), target.with_name(target.name + ".etag")
    failures = 0
    while True:
        before = _size(part)
        try:
            _fetch(url, part, note, patience.timeout_s, progress)
            break
        except (_Interrupted, http.client.HTTPException, OSError) as error:
            failures = 1 if _size(part) > before else failures + 1
            if failures >= patience.attempts:
                reason = str(getattr(error, "reason", error)) or type(error).__name__
                raise FileError(url, f"download broke off ({reason})", CHECK_CONNECTION) from None
            time.sleep(patience.wait_s * 2 ** (failures - 1))
    etag = note.read_text() if note.exists() else ""
    found = file_sha256(part)
    try:
        if sha256 is not None and found != sha256.lower():
            problem = f"SHA-256 is {found}, expected {sha256}"
            raise FileError(url, problem, "the file on the server has changed or was tampered with")
        if etag_is_digest and not _matches_etag(part, etag):
            raise FileError(url, f"content differs from its ETag {etag}", "download it again")
    except FileError:
        part.unlink()
        raise
    finally:
        note.unlink(missing_ok=True)
    os.replace(part, target)
    return found


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, lower-case hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _fetch(
    url: str,
    part: Path,
    note: Path,
    timeout_s: float,
    progress: Callable[[int, int | None], None] | None,
) -> None:
    """One try: go on with the part there is, or begin. Returns when the content is complete."""
    request = urllib.request.Request(url, headers={"User-Agent": "tpcd"})
    have = _size(part)
    known = note.read_text() if have and note.exists() else ""
    if known:
        request.add_header("Range", f"bytes={have}-")
        request.add_header("If-Range", known)
    try:
        response = urllib.request.urlopen(request, timeout=timeout_s)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # the part holds as much as the server has, or more
            part.unlink()
            raise _Interrupted("the part was longer than the file") from None
        if error.code in (408, 429) or error.code >= 500:
            raise _Interrupted(f"HTTP {error.code} {error.reason}") from None
        remedy = "check the name and the base address" if error.code in (403, 404) else ""
        raise FileError(url, f"the server answers {error.code} {error.reason}", remedy) from None
    with response:
        resumed = response.status == 206
        if resumed and not response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
            part.unlink()
            raise _Interrupted("the server sent another range than asked")
        done = have if resumed else 0
        length = response.headers.get("Content-Length")
        total = done + int(length) if length and length.isdigit() else None
        note.write_text(response.headers.get("ETag", ""))
        with part.open("ab" if resumed else "wb") as stream:
            while block := response.read(BLOCK):
                with named(part):
                    stream.write(block)
                done += len(block)
                if progress:
                    progress(done, total)
    if total is not None and done < total:
        raise _Interrupted(f"{done} of {total} bytes came")


def _matches_etag(path: Path, etag: str) -> bool:
    """Whether S3's ETag fits: MD5 of the content, or of the MD5s of its 8 MiB parts.

    ETags of another make, or of another number of parts, say nothing and count as fitting.
    """
    found = re.fullmatch(r'"?([0-9a-f]{32})(?:-(\d+))?"?', etag.strip())
    if not found:
        return True
    content = path.read_bytes()
    if found[2] is None:
        return hashlib.md5(content, usedforsecurity=False).hexdigest() == found[1]
    count = int(found[2])
    if math.ceil(len(content) / UPLOAD_PART) != count:
        return True
    parts = [content[i * UPLOAD_PART : (i + 1) * UPLOAD_PART] for i in range(count)]
    digests = b"".join(hashlib.md5(part, usedforsecurity=False).digest() for part in parts)
    return hashlib.md5(digests, usedforsecurity=False).hexdigest() == found[1]


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
