"""Check a recording before it is believed: see tpcd/quality/README.md.

python scripts/check.py run.csv --map time=t:ms x=X:mm z=Z:mm ... --out runs/check
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tpcd.cli import check_numbers, run


@dataclass(frozen=True)
class Check:
    """Settings of the command; SI units."""

    recording: Path
    """CSV (any separator), Parquet, ROS 1 bag, ROS 2 bag (folder, .db3), MCAP, or an episode."""
    out: Path = Path("runs/check")
    """Folder for the page and its pictures."""
    map: tuple[str, ...] = ()
    """Columns of a table, as NAME=COLUMN or NAME=COLUMN:UNIT (scripts/import_log.py lists the
    names); without it the columns are taken by their names, and told."""
    topics: tuple[str, ...] = ()
    """Topics of a bag, as pose=TOPIC, wrench=TOPIC, command=TOPIC; needed where several fit."""
    euler: str = "ZYX"
    """Axes of Euler angles e1 e2 e3; capitals for axes that turn along."""
    rate: float | None = None
    """Samples a second [Hz], for tables without times."""
    stiffness: tuple[float, ...] = ()
    """What the controller was given: along and about x, y, z [N/m, N/m, N/m, N·m/rad, N·m/rad,
    N·m/rad], or along x and z and about the angle's axis; the gain of the sensor needs it."""
    overwrite: bool = False
    """Replace an earlier check in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, above={"rate": 0.0, "stiffness": 0.0})
        if len(self.stiffness) not in (0, 3, 6):
            raise ValueError(f"stiffness has {len(self.stiffness)} numbers, expected 3 or 6")


def check_recording(config: Check) -> int:
    """Say channel by channel and row by row what is wrong with a recording, and what it tells of
    arm and sensor without a model of contact.

    Returns 0 where it is usable, 4 where it is with samples left out or in doubt, 5 where it is
    not usable as it is read, and 2 where it cannot be read.
    """
    from tpcd.commands.check_file import check_file
    from tpcd.commands.check_rows import channel_rows
    from tpcd.commands.checking import plain_finding, write_check, written_page
    from tpcd.commands.verdict import verdict
    from tpcd.results import run_folder, write_results

    checked = check_file(
        config.recording,
        config.map,
        config.topics,
        config.euler,
        config.rate,
        config.stiffness or None,
    )
    code, sentence = verdict(checked)
    print(written_page(checked))
    with run_folder(config.out, "scripts/check.py", config, config.overwrite) as folder:
        write_check(checked, folder)
        findings = [plain_finding(each) for each in checked.findings]
        write_results(
            folder, channel_rows(checked), verdict=sentence, exit_code=code, findings=findings
        )
    print(f"\npage in {config.out}/check.html")
    return code


if __name__ == "__main__":
    run(check_recording, Check, positional=("recording",))
