"""Train a shape prior and export it: `python -m training.train --config FILE.yaml`.

Writes a run folder (Lightning checkpoints for resuming, TensorBoard, the resolved
configuration) and, at the end, the released prior: safetensors and a JSON card.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from jsonargparse import ActionConfigFile, ArgumentParser

from tpcd.errors import TpcdError
from training.config import TrainingConfig


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = ArgumentParser(prog="python -m training.train", description=__doc__)
    parser.add_argument("--config", action=ActionConfigFile, help="YAML file of a prior")
    parser.add_class_arguments(TrainingConfig, as_group=False)
    parser.add_argument("--out", type=str, default="", help="run folder (default runs/NAME)")
    parser.add_argument(
        "--export", type=str, default="", help="checkpoint folder (default OUT/NAME)"
    )
    parser.add_argument("--resume", action="store_true", help="go on from OUT's last checkpoint")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    options = parser.instantiate(parser.parse_args(arguments))
    config = TrainingConfig(**{name: options[name] for name in TrainingConfig.__dataclass_fields__})
    out = Path(options.out or Path("runs") / config.name)
    # torch and Lightning take seconds to import; --help should not wait for them.
    from training.run import train

    try:
        began = time.process_time()
        folder = train(config, out, Path(options.export or out / config.name), options.resume)
        print(f"prior written to {folder} ({time.process_time() - began:.0f} CPU s in all)")
    except (TpcdError, ValueError) as error:
        if options.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return getattr(error, "exit_code", 2)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
