"""From the YCB archives on the set's own site to a folder of meshes and outlines.

`fetch_object` brings one mesh, `write_slices` cuts all meshes of a folder into `slices.npz`
and `slices_extra.npz`, the files `ycb.load_ycb` reads. The folder's `manifest.json` records
address, size and SHA-256 of every archive and mesh at its first download; what is fetched
again must agree with it.

The site publishes no checksum files. Its archives lie on Amazon S3, whose ETags are digests
of the content (Amazon S3 user guide, "Checking object integrity"); these are checked.
Address pattern: the set's own `ycb_downloader.py`, as in sea-bass/ycb-tools
(`download_ycb_dataset.py`): `.../data/google/<object>_google_16k.tgz`.
"""

from __future__ import annotations

import json
import os
import tarfile
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tpcd.errors import FileError, OutlineError
from tpcd.files import named, staged, write_text
from tpcd.shape.download import Patience, download, file_sha256

BASE_URL = "https://ycb-benchmarks.s3.amazonaws.com/data/google/"
LARGEST_MESH = 200 << 20
"""No mesh of the set comes near this size [bytes]; an archive that claims so is refused."""
SIMPLIFY = 3e-5
"""Outlines are thinned out by at most this much [m]."""
REPRESENTATIVE = 0.85
"""Extra views are kept where the cut covers this share of the silhouette."""

FLAT = frozenset(
    (
        "011_banana",
        "030_fork",
        "031_spoon",
        "032_knife",
        "033_spatula",
        "035_power_drill",
        "037_scissors",
        "040_large_marker",
        "042_adjustable_wrench",
        "043_phillips_screwdriver",
        "044_flat_screwdriver",
        "048_hammer",
        "050_medium_clamp",
        "051_large_clamp",
        "052_extra_large_clamp",
        "072-b_toy_airplane",
    )
)
"""Objects scanned lying: the outline is the silhouette from above."""
HOLLOW = frozenset(
    (
        *(f"065-{letter}_cups" for letter in "abcdefghij"),
        "072-a_toy_airplane",
        "073-e_lego_duplo",
    )
)
"""Objects no plane represents, and the cups (065), which any plane cuts into thin walls: the
outline is the silhouette from the side."""
HANDLED = frozenset(
    (
        "014_lemon",
        "019_pitcher_base",
        "025_mug",
    )
)
"""Objects cut along their largest diameter: through the handle or the tips."""
OPEN_OR_SUNK = frozenset(
    (
        "002_master_chef_can",
        "005_tomato_soup_can",
        "007_tuna_fish_can",
        "010_potted_meat_can",
        "019_pitcher_base",
        "024_bowl",
        "025_mug",
        "029_plate",
        "072-c_toy_airplane",
        "072-d_toy_airplane",
        "072-e_toy_airplane",
        "073-a_lego_duplo",
        "073-b_lego_duplo",
        "073-c_lego_duplo",
        "073-d_lego_duplo",
        "073-f_lego_duplo",
    )
)
"""Bowls, bricks, cans with sunk lids: closed by a straight line where open up or down."""
UNSUITABLE = frozenset(
    (
        "022_windex_bottle",
        "028_skillet_lid",
        "038_padlock",
        "059_chain",
        "063-a_marbles",
        "070-a_colored_wood_blocks",
        "073-g_lego_duplo",
    )
)
"""Scans without an outline worth having: transparent parts missing, heaps, a chain."""


@dataclass(frozen=True)
class Record:
    """What the manifest keeps of one object."""

    url: str
    archive_bytes: int
    archive_sha256: str
    mesh_sha256: str


def fetch_object(
    name: str,
    folder: str | Path,
    *,
    base_url: str = BASE_URL,
    patience: Patience | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> bool:
    """Put `meshes/<name>.ply` into the folder; False where it was there and intact already.

    Raises:
        FileError: the download fails, the archive is corrupt or has no such mesh, or it is not
            the one the manifest records.
    """
    folder = Path(folder)
    mesh, archive = folder / "meshes" / f"{name}.ply", folder / "archives" / f"{name}.tgz"
    manifest = read_manifest(folder)
    known = manifest.get(name)
    if known and mesh.is_file() and file_sha256(mesh) == known.mesh_sha256:
        return False
    url = f"{base_url.rstrip('/')}/{name}_google_16k.tgz"
    digest = download(
        url,
        archive,
        sha256=known.archive_sha256 if known else None,
        etag_is_digest=".amazonaws.com/" in base_url,
        patience=patience,
        progress=progress,
    )
    try:
        size = archive.stat().st_size
        extract_mesh(archive, f"{name}/google_16k/nontextured.ply", mesh)
    finally:
        archive.unlink()
    manifest[name] = Record(url, size, digest, file_sha256(mesh))
    write_manifest(folder, manifest)
    return True


def extract_mesh(archive: Path, member: str, target: Path) -> None:
    """Write one regular file of a `.tgz` to `target`; the whole archive is read and checked.

    Nothing else is unpacked, and no name inside the archive decides where anything goes.

    Raises:
        FileError: corrupt or cut off, or without that file.
    """
    part = target.with_name(target.name + ".part")
    found = False
    try:
        with tarfile.open(archive, "r:gz") as content:
            for entry in content:
                if not found and entry.name.removeprefix("./") == member and entry.isfile():
                    if entry.size > LARGEST_MESH:
                        raise FileError(archive, f"{member} claims {entry.size} bytes")
                    stream = content.extractfile(entry)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    mesh = stream.read() if stream else b""
                    with named(target):
                        part.write_bytes(mesh)
                    found = True
            # The checksum of gzip stands at its very end, behind what tar reads.
            while content.fileobj is not None and content.fileobj.read(1 << 20):
                pass
    except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is not None:  # a full disk, for one
            raise
        raise FileError(archive, f"corrupt archive ({error})", "download it again") from None
    if not found:
        raise FileError(archive, f"holds no {member}", "the site may have changed its layout")
    os.replace(part, target)


def write_slices(folder: str | Path) -> dict[str, str]:
    """Cut every mesh of the folder; returns the objects without an outline and why.

    Writes `slices.npz` (main outlines) and `slices_extra.npz` (`<object>/side` and `/top` of
    upright objects, where the cut represents the object), vertices (n, 2) [m].

    Raises:
        FileError: there are no meshes, or none gives an outline.
    """
    folder = Path(folder)
    paths = sorted(p for p in (folder / "meshes").glob("*.ply") if p.stem not in UNSUITABLE)
    if not paths:
        raise FileError(folder / "meshes", "holds no usable .ply meshes", "fetch some first")
    main: dict[str, np.ndarray] = {}
    extra: dict[str, np.ndarray] = {}
    problems: dict[str, str] = {}
    for path in paths:
        try:
            main[path.stem], views = _views(path)
            extra.update(views)
        except OutlineError as error:
            problems[path.stem] = error.problem
    if not main:
        raise FileError(
            folder / "meshes", "no mesh gives an outline", next(iter(problems.values()))
        )
    _write_arrays(folder / "slices.npz", main)
    _write_arrays(folder / "slices_extra.npz", extra)
    return problems


def read_manifest(folder: Path) -> dict[str, Record]:
    """The folder's records by object name; empty where there is no manifest."""
    path = folder / "manifest.json"
    if not path.exists():
        return {}
    try:
        return {name: Record(**entry) for name, entry in json.loads(path.read_text()).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise FileError(path, f"malformed ({error})", "delete it to start anew") from None


def write_manifest(folder: Path, manifest: dict[str, Record]) -> None:
    """Write all records at once."""
    text = json.dumps({name: asdict(manifest[name]) for name in sorted(manifest)}, indent=2)
    write_text(folder / "manifest.json", text + "\n")


def _views(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Main outline of a mesh, and its side and top views by name."""
    from tpcd.shape.mesh import load_mesh
    from tpcd.shape.section import (
        CuttingPlane,
        cut_mesh,
        mesh_silhouette,
        upright_plane,
    )

    name, mesh = path.stem, load_mesh(path)
    front = upright_plane(mesh, "longest" if name in HANDLED else "rectangle")
    across, up, normal = front.axes()
    above = CuttingPlane(front.origin, up, -normal)
    if name in FLAT:
        return _thinned(mesh_silhouette(mesh, name, above, path=path).vertices), {}
    if name in HOLLOW:
        return _thinned(mesh_silhouette(mesh, name, front, path=path).vertices), {}
    closed = name in OPEN_OR_SUNK
    main = cut_mesh(mesh, name, front, close_recesses=closed, path=path)
    views = {}
    for view, plane in (("side", CuttingPlane(front.origin, across, up)), ("top", above)):
        try:
            cut = cut_mesh(mesh, name, plane, close_recesses=closed and view == "side", path=path)
            whole = mesh_silhouette(mesh, name, plane, path=path)
        except OutlineError:
            continue  # an extra view that does not work out is simply not there
        if not cut.notes and cut.area >= REPRESENTATIVE * whole.area:
            views[f"{name}/{view}"] = _thinned(cut.vertices)
    return _thinned(main.vertices), views


def _thinned(vertices: np.ndarray) -> np.ndarray:
    import shapely

    return shapely.get_coordinates(shapely.Polygon(vertices).simplify(SIMPLIFY))[:-1]


def _write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with staged(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
