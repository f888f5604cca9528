"""Download the YCB meshes and cut them into outlines.

    python scripts/fetch_ycb.py ../shared/ycb
    python scripts/fetch_ycb.py ~/ycb --objects 006_mustard_bottle 025_mug

Set TPCD_YCB to the folder afterwards (`../shared/ycb` beside the repository is found by
itself). Run it again after a broken connection: it goes on where it stopped.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import check_numbers, run

YCB_NAME = re.compile(r"\d{3}(-[a-z])?_[a-z_]+")
"""How the set names its objects: 025_mug, 065-f_cups."""


@dataclass(frozen=True)
class Fetching:
    """Settings of the download."""

    folder: Path
    """Folder to fill with meshes, outlines and a manifest of checksums."""
    objects: tuple[str, ...] = ()
    """Names of YCB objects; the 21 of YCB-Video where none are given."""
    base_url: str = "https://ycb-benchmarks.s3.amazonaws.com/data/google/"
    """Where the archives <object>_google_16k.tgz are."""
    attempts: int = 5
    """Tries for each file before giving up."""
    timeout_s: float = 30.0
    """Silence of the server that ends a try [s]."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"attempts": 1}, above={"timeout_s": 0.0})
        if not self.base_url.startswith(("http://", "https://")):
            raise ValueError(f"base_url is {self.base_url!r}, expected http:// or https://")
        for name in self.objects:
            if not YCB_NAME.fullmatch(name):
                raise ValueError(f"objects: {name!r} is no name of the set, such as 025_mug")


def fetch(config: Fetching) -> int:
    """Download YCB meshes (CC BY 4.0) from the set's own site and cut them into outlines."""
    from tpcd.ownership import owned

    with owned(config.folder, "scripts/fetch_ycb.py"):
        return _fetch(config)


def _fetch(config: Fetching) -> int:
    from contextlib import suppress

    from tqdm import tqdm

    from tpcd.errors import FileError
    from tpcd.shape.download import Patience
    from tpcd.shape.ycb import GRASPABLE_21
    from tpcd.shape.ycb_archive import fetch_object, write_slices
    from tpcd.targets import check_target

    check_target(config.folder / "slices.npz", overwrite=True)
    names = config.objects or GRASPABLE_21
    patience = Patience(attempts=config.attempts, timeout_s=config.timeout_s)
    failed: dict[str, FileError] = {}
    for name in names:
        with tqdm(desc=name, unit="B", unit_scale=True, leave=False, disable=None) as bar:

            def show(done: int, total: int | None, bar: tqdm = bar) -> None:
                bar.total = total
                bar.update(done - bar.n)

            try:
                new = fetch_object(
                    name,
                    config.folder,
                    base_url=config.base_url,
                    patience=patience,
                    progress=show,
                )
                outcome = "downloaded" if new else "already there"
            except FileError as error:
                outcome = f"failed: {error}"
                failed[name] = error
        print(f"{name}: {outcome}")
    if len(failed) == len(names):
        for empty in (config.folder / "archives", config.folder):
            with suppress(OSError):  # a part of an archive is kept, to go on from there
                empty.rmdir()
        last = failed[names[-1]]
        raise FileError(config.folder, f"nothing was downloaded: {last.problem}", last.remedy)
    for name, problem in write_slices(config.folder).items():
        print(f"{name}: no outline: {problem}")
    print(f"outlines are in {config.folder / 'slices.npz'}; export TPCD_YCB={config.folder}")
    return 2 if failed else 0


if __name__ == "__main__":
    run(fetch, Fetching, positional=("folder",))
