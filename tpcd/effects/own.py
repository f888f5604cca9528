"""Effects of a user's own, from a Python file that holds `EFFECTS = (effect, ...)`.

tpcd/effects/README.md says how to write one. Reading such a file runs the code in it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from tpcd.effects.check import check_effect
from tpcd.effects.protocol import SITES, Effect
from tpcd.errors import EffectError, ModelError


def load_effects(path: Path) -> tuple[Effect, ...]:
    """The effects that a Python file holds in `EFFECTS`; raises `ModelError`."""
    path = path.resolve()
    if not path.is_file():
        raise ModelError(path, "no such file", "give a Python file that holds EFFECTS")
    # Two files of one name in different folders are two modules.
    name = f"tpcd_user_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ModelError(path, "is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ModelError(path, f"fails when it is run: {type(error).__name__}: {error}") from error
    effects = getattr(module, "EFFECTS", None)
    if not isinstance(effects, (tuple, list)) or not effects:
        raise ModelError(path, "holds no EFFECTS", "expected EFFECTS = (effect, ...)")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ModelError(
                path,
                f"EFFECTS holds {effect!r}",
                "expected effects as tpcd/effects/README.md shows",
            )
        if effect.site not in SITES:
            raise ModelError(
                path,
                f"{effect.name!r} has the site {effect.site!r}",
                f"expected one of {', '.join(SITES)}",
            )
        try:
            check_effect(effect)
        except EffectError as error:
            raise ModelError(path, str(error), "see tpcd/effects/README.md") from error
        if not getattr(effect, "source", None):
            object.__setattr__(effect, "source", str(path))
    names = [effect.name for effect in effects]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ModelError(path, f"EFFECTS holds {twice[0]!r} twice", "give each its own name")
    return tuple(effects)


def load_candidates(paths: Sequence[Path], known: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects of Python files, each of another name than those before it and the `known`
    ones; raises `ModelError`."""
    found: list[Effect] = []
    for path in paths:
        for effect in load_effects(path):
            if effect.name in [one.name for one in (*known, *found)]:
                problem = f"holds an effect {effect.name!r}, of which there is one already"
                raise ModelError(path, problem, "give it a name of its own")
            found.append(effect)
    return tuple(found)


def file_sha256(path: Path) -> str:
    """SHA-256 of what a file holds."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
