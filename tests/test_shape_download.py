"""Downloads against a server on this machine: complete, resumed, corrupt, refused, cut off."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import json
import subprocess
import sys
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.exchange.ply import export_ply

from tpcd.errors import FileError
from tpcd.shape.download import UPLOAD_PART, Patience, download
from tpcd.shape.ycb_archive import extract_mesh, fetch_object, read_manifest, write_slices

CONTENT = np.random.default_rng(0).bytes(300_000)
QUICK = Patience(attempts=3, wait_s=0.0, timeout_s=5.0)
NAME = "003_cracker_box"


@dataclass
class Site:
    """What the server offers and how it misbehaves; it notes every request."""

    files: dict[str, bytes] = field(default_factory=dict)
    etag: str | None = '"first"'
    ranges: bool = True
    cut_after: list[int] = field(default_factory=list)
    """Bytes after which the first, second, ... answer breaks off; later ones are whole."""
    codes: list[int] = field(default_factory=list)
    """Status codes of the first answers, instead of the file."""
    url: str = ""
    asked: list[str | None] = field(default_factory=list)
    """The Range header of every request."""


@pytest.fixture
def site() -> Iterator[Site]:
    """A running server on 127.0.0.1."""
    site = Site(files={"/file": CONTENT})

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            site.asked.append(self.headers.get("Range"))
            if site.codes:
                self.send_error(site.codes.pop(0))
                return
            if self.path not in site.files:
                self.send_error(404)
                return
            content, first = site.files[self.path], 0
            asked = self.headers.get("Range")
            if asked and site.ranges and self.headers.get("If-Range") in (None, site.etag):
                first = int(asked.removeprefix("bytes=").rstrip("-"))
                if first >= len(content):
                    self.send_error(416)
                    return
                self.send_response(206)
                self.send_header(
                    "Content-Range", f"bytes {first}-{len(content) - 1}/{len(content)}"
                )
            else:
                self.send_response(200)
            self.send_header("Content-Length", str(len(content) - first))
            if site.etag is not None:
                self.send_header("ETag", site.etag)
            self.end_headers()
            stop = first + site.cut_after.pop(0) if site.cut_after else len(content)
            with contextlib.suppress(ConnectionError):
                self.wfile.write(content[first:stop])

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    site.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield site
    server.shutdown()
    thread.join()
    server.server_close()


def refusal(*arguments, **options) -> str:
    with pytest.raises(FileError) as caught:
        download(*arguments, patience=QUICK, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_download_is_complete_and_leaves_nothing_else(site, tmp_path):
    seen = []
    digest = download(
        f"{site.url}/file",
        tmp_path / "deep" / "file",
        progress=lambda done, total: seen.append((done, total)),
    )
    assert (tmp_path / "deep" / "file").read_bytes() == CONTENT
    assert digest == hashlib.sha256(CONTENT).hexdigest()
    assert leftovers(tmp_path / "deep") == ["file"]
    assert seen[-1] == (len(CONTENT), len(CONTENT))


def test_a_broken_line_is_taken_up_where_it_broke(site, tmp_path):
    site.cut_after = [100_000, 50_000]
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert site.asked == [None, "bytes=100000-", "bytes=150000-"]


def test_a_later_call_goes_on_from_an_earlier_one(site, tmp_path):
    site.cut_after = [100_000, 0, 0]
    assert "download broke off" in refusal(f"{site.url}/file", tmp_path / "file")
    assert leftovers(tmp_path) == ["file.etag", "file.part"]
    site.asked.clear()
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert site.asked == ["bytes=100000-"]
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert leftovers(tmp_path) == ["file"]


def test_a_part_of_another_version_is_not_gone_on_with(site, tmp_path):
    site.cut_after = [100_000, 0, 0]
    refusal(f"{site.url}/file", tmp_path / "file")
    site.files["/file"], site.etag = CONTENT[::-1], '"second"'
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert (tmp_path / "file").read_bytes() == CONTENT[::-1]


@pytest.mark.parametrize(("etag", "ranges"), [(None, True), ('"first"', False)])
def test_servers_without_etag_or_ranges_are_asked_anew(site, tmp_path, etag, ranges):
    site.etag, site.ranges, site.cut_after = etag, ranges, [100_000]
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert (tmp_path / "file").read_bytes() == CONTENT


def test_a_part_longer_than_the_file_is_thrown_away(site, tmp_path):
    (tmp_path / "file.part").write_bytes(CONTENT + b"too much")
    (tmp_path / "file.etag").write_text('"first"')
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert (tmp_path / "file").read_bytes() == CONTENT


@pytest.mark.parametrize("code", [500, 503, 429])
def test_a_server_in_trouble_is_asked_again(site, tmp_path, code):
    site.codes = [code, code]
    download(f"{site.url}/file", tmp_path / "file", patience=QUICK)
    assert len(site.asked) == 3


def test_patience_ends(site, tmp_path):
    site.codes = [503] * 9
    assert "download broke off (HTTP 503" in refusal(f"{site.url}/file", tmp_path / "file")
    assert len(site.asked) == QUICK.attempts
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("code", [403, 404])
def test_a_missing_file_is_reported_at_once(site, tmp_path, code):
    site.codes = [code]
    message = refusal(f"{site.url}/file", tmp_path / "file")
    assert f"{site.url}/file: the server answers {code}" in message
    assert "check the name and the base address" in message
    assert len(site.asked) == 1 and leftovers(tmp_path) == []


def test_nobody_at_the_address_is_reported(tmp_path):
    message = refusal("http://127.0.0.1:9/file", tmp_path / "file")
    assert "check the connection" in message


def test_content_of_another_checksum_is_deleted(site, tmp_path):
    message = refusal(f"{site.url}/file", tmp_path / "file", sha256="0" * 64)
    assert "SHA-256 is" in message and "expected 000" in message
    assert leftovers(tmp_path) == []


def test_the_right_checksum_is_accepted_in_either_case(site, tmp_path):
    digest = hashlib.sha256(CONTENT).hexdigest().upper()
    assert download(f"{site.url}/file", tmp_path / "file", sha256=digest) == digest.lower()


def test_an_existing_file_survives_a_failed_download(site, tmp_path):
    (tmp_path / "file").write_bytes(b"old")
    refusal(f"{site.url}/file", tmp_path / "file", sha256="0" * 64)
    assert (tmp_path / "file").read_bytes() == b"old"


def s3_etag(content: bytes) -> str:
    starts = range(0, len(content), UPLOAD_PART)
    digests = [hashlib.md5(content[i : i + UPLOAD_PART]) for i in starts]
    if len(digests) == 1:
        return f'"{digests[0].hexdigest()}"'
    together = hashlib.md5(b"".join(digest.digest() for digest in digests))
    return f'"{together.hexdigest()}-{len(digests)}"'


@pytest.mark.parametrize("size", [1000, UPLOAD_PART + 1])
def test_an_etag_made_of_digests_is_checked(site, tmp_path, size):
    content = bytes(size)
    site.files["/file"], site.etag = content, s3_etag(content)
    download(f"{site.url}/file", tmp_path / "file", etag_is_digest=True)
    site.files["/file"] = content[:-1] + b"x"
    message = refusal(f"{site.url}/file", tmp_path / "other", etag_is_digest=True)
    assert "content differs from its ETag" in message
    assert leftovers(tmp_path) == ["file"]


@pytest.mark.parametrize("etag", [None, '"abc"', 'W/"abc"', f'"{"0" * 32}-7"'])
def test_etags_of_another_make_say_nothing(site, tmp_path, etag):
    site.etag = etag
    download(f"{site.url}/file", tmp_path / "file", etag_is_digest=True)
    assert (tmp_path / "file").exists()


@pytest.mark.parametrize("url", ["file:///etc/hostname", "ftp://host/file", "host/file"])
def test_only_http_addresses_are_taken(tmp_path, url):
    with pytest.raises(ValueError, match="http"):
        download(url, tmp_path / "file")


def archive(members: dict[str, bytes], **attributes) -> bytes:
    """A `.tgz` with these files."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as content:
        for name, data in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            for key, value in attributes.items():
                setattr(entry, key, value)
            content.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


def crate() -> bytes:
    mesh = trimesh.creation.box(extents=(0.06, 0.16, 0.21))
    return export_ply(mesh)


def member(name: str = NAME) -> str:
    return f"{name}/google_16k/nontextured.ply"


@pytest.fixture
def ycb_site(site) -> Site:
    site.files[f"/{NAME}_google_16k.tgz"] = archive({"readme": b"x" * 5000, member(): crate()})
    return site


def test_an_object_arrives_as_mesh_and_record(ycb_site, tmp_path):
    assert fetch_object(NAME, tmp_path, base_url=ycb_site.url, patience=QUICK)
    mesh = tmp_path / "meshes" / f"{NAME}.ply"
    assert mesh.read_bytes() == crate()
    record = read_manifest(tmp_path)[NAME]
    assert record.mesh_sha256 == hashlib.sha256(crate()).hexdigest()
    assert record.url == f"{ycb_site.url}/{NAME}_google_16k.tgz"
    assert leftovers(tmp_path / "archives") == []


def test_what_is_there_and_intact_is_not_fetched_again(ycb_site, tmp_path):
    fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    ycb_site.asked.clear()
    assert not fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    assert ycb_site.asked == []


def test_a_damaged_mesh_is_fetched_again(ycb_site, tmp_path):
    fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    mesh = tmp_path / "meshes" / f"{NAME}.ply"
    mesh.write_bytes(b"damaged")
    assert fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    assert mesh.read_bytes() == crate()


def test_an_archive_that_changed_since_its_first_download_is_refused(ycb_site, tmp_path):
    fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    (tmp_path / "meshes" / f"{NAME}.ply").unlink()
    ycb_site.files[f"/{NAME}_google_16k.tgz"] = archive({member(): crate() + b"\n"})
    with pytest.raises(FileError, match="SHA-256"):
        fetch_object(NAME, tmp_path, base_url=ycb_site.url)
    assert not (tmp_path / "meshes" / f"{NAME}.ply").exists()


def corrupted(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (archive({member(): crate()})[:-30], "corrupt archive"),
        (archive({member(): crate()})[:-4], "corrupt archive"),
        (corrupted(archive({member(): CONTENT})), "corrupt archive"),
        (b"<html>no archive</html>", "corrupt archive"),
        (b"", "corrupt archive"),
        (gzip.compress(b"no tar inside" * 100, mtime=0), "corrupt archive"),
        (archive({"readme": b"only words"}), f"holds no {member()}"),
        (archive({f"../{member()}": crate()}), f"holds no {member()}"),
        (archive({member(): b""}, type=tarfile.SYMTYPE, linkname="/etc/hostname"), "holds no"),
    ],
)
def test_a_bad_archive_is_refused_and_leaves_nothing(site, tmp_path, content, expected):
    site.files[f"/{NAME}_google_16k.tgz"] = content
    with pytest.raises(FileError, match=expected):
        fetch_object(NAME, tmp_path, base_url=site.url, patience=QUICK)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_nothing_is_written_outside_the_target(tmp_path):
    source = tmp_path / "in.tgz"
    source.write_bytes(archive({"../escaped": b"!", "/absolute": b"!", member(): crate()}))
    (tmp_path / "out").mkdir()
    extract_mesh(source, member(), tmp_path / "out" / "mesh.ply")
    assert leftovers(tmp_path / "out") == ["mesh.ply"]
    assert leftovers(tmp_path) == ["in.tgz", "out"]


def test_a_malformed_manifest_is_refused(tmp_path):
    (tmp_path / "manifest.json").write_text('{"thing": {"url": "x"}}')
    with pytest.raises(FileError, match="manifest.json: malformed"):
        read_manifest(tmp_path)


def test_slices_of_no_meshes_are_refused(tmp_path):
    with pytest.raises(FileError, match="holds no usable .ply meshes"):
        write_slices(tmp_path)


def test_meshes_without_an_outline_are_reported(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "good.ply").write_bytes(crate())
    (tmp_path / "meshes" / "bad.ply").write_bytes(b"garbage")
    problems = write_slices(tmp_path)
    assert list(problems) == ["bad"] and "does not begin with 'ply'" in problems["bad"]
    with np.load(tmp_path / "slices.npz") as arrays:
        np.testing.assert_allclose(np.ptp(arrays["good"], axis=0), [0.16, 0.21], atol=1e-6)
    with np.load(tmp_path / "slices_extra.npz") as arrays:
        assert sorted(arrays.files) == ["good/side", "good/top"]


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).resolve().parents[1]
    script = str(root / "scripts" / "fetch_ycb.py")
    return subprocess.run(
        [sys.executable, script, *arguments],
        capture_output=True,
        text=True,
        cwd=root,
        env={"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
        timeout=120,
        check=False,
    )


def test_the_command_makes_a_folder_that_serves_as_ycb(ycb_site, tmp_path, monkeypatch):
    from tpcd.shape.ycb import FOLDER_VARIABLE, load_ycb

    done = command(str(tmp_path), "--objects", NAME, "--base-url", ycb_site.url)
    assert done.returncode == 0, done.stderr
    assert f"{NAME}: downloaded" in done.stdout
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    assert load_ycb("all")[NAME].size == pytest.approx((0.16, 0.21), abs=1e-6)
    assert list(json.loads((tmp_path / "manifest.json").read_text())) == [NAME]


def test_the_command_names_what_failed_and_exits_with_2(ycb_site, tmp_path):
    some = command(str(tmp_path), "--objects", NAME, "999_unicorn", "--base-url", ycb_site.url)
    assert some.returncode == 2
    assert "999_unicorn: failed: http://127.0.0.1" in some.stdout and "404" in some.stdout
    assert (tmp_path / "slices.npz").exists()
    none = command(str(tmp_path / "b"), "--objects", "999_unicorn", "--base-url", ycb_site.url)
    assert none.returncode == 2
    assert "nothing was downloaded" in none.stderr and "Traceback" not in none.stderr
