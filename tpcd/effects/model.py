"""An augmented model as a file: which effects the simulator has besides, how it steps, and what
shapes it expects.

A YAML file:

    effects:
      - name: floor_compliance           # from the catalogue, or a formula
        parameters:                      # optional: narrower priors, SI units
          compliance: [1.0e-4, 4.0e-4]
        found:                           # optional: mean and standard deviation
          compliance: [2.1e-4, 1.6e-5]
      - name: magnet                     # an effect of your own
        file: my_effects.py              # relative to this file; holds EFFECTS = (...)
    step:                                # optional: settings of the step
      substeps: 6
    shape:                               # optional: an object unlike those of the shape prior
      scale: [0.4, 2.4]                  # range of its scale
      misfit: 4.0                        # times as much error of the outline is expected

Estimates, explorations and diagnoses take the shape; a belief that is there has its own.

Reading a file with `file:` runs the Python code in it; tpcd/effects/README.md says how to write
one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from tpcd.effects.catalogue import KNOWN, find_effect
from tpcd.effects.declare import DeclaredEffect
from tpcd.effects.own import file_sha256, load_effects
from tpcd.effects.protocol import Effect, EffectParameter, effect_to_plain
from tpcd.effects.shape_change import UNCHANGED, ShapeChange, shape_from_plain
from tpcd.errors import ModelError
from tpcd.files import write_text
from tpcd.plain_yaml import read_yaml, to_yaml
from tpcd.simulator.record import StepSettings

Found = Mapping[str, Mapping[str, tuple[float, float]]]
"""Mean and standard deviation [SI units] that data gave parameters of effects, by both names."""
REACH = 4.0
"""Standard deviations about what was found that a prior keeps."""
MOST = 10.0
"""Sizes beyond so many times those of an effect's own range are in another unit."""


@dataclass(frozen=True)
class Model:
    """Effects, settings of the step, what is known of the effects, and what of the shape."""

    effects: tuple[Effect, ...] = ()
    step: StepSettings = StepSettings()
    found: Found = field(default_factory=dict)
    shape: ShapeChange = UNCHANGED

    @property
    def informed(self) -> tuple[Effect, ...]:
        """The effects for an estimate from other data: priors narrowed to what was found, within
        `REACH` standard deviations and the range they have. Effects of a user's own class stay."""
        return tuple(
            _with_priors(effect, _narrowed(effect, self.found.get(effect.name, {})))
            if isinstance(effect, DeclaredEffect)
            else effect
            for effect in self.effects
        )


def load_model(path: str | Path) -> Model:
    """Read a model file; raises `ModelError` with what is wrong in one line."""
    path = Path(path)
    content = read_yaml(path, ModelError, "give the model.yaml that diagnose wrote")
    if not isinstance(content, Mapping):
        raise ModelError(path, "is not a mapping", "expected 'effects' and optionally 'step'")
    unknown = sorted(set(content) - {"effects", "step", "shape", "notes"})
    if unknown:
        expected = "expected 'effects', 'step', 'shape' and 'notes'"
        raise ModelError(path, f"has {unknown[0]!r}", expected)
    effects = effects_from_plain(content.get("effects") or [], path)
    given = content.get("step") or {}
    known = [setting.name for setting in fields(StepSettings)]
    if not isinstance(given, Mapping) or set(given) - set(known):
        raise ModelError(path, f"step is {given!r}", f"expected any of {', '.join(known)}")
    try:
        step = StepSettings(**given)
    except (TypeError, ValueError) as error:
        raise ModelError(path, f"step: {error}") from error
    try:
        shape = shape_from_plain(content.get("shape") or {})
    except ValueError as error:
        raise ModelError(path, str(error)) from error
    return Model(effects, step, _found_of(content.get("effects") or [], effects, path), shape)


def write_model(model: Model, path: str | Path, notes: str | None = None) -> Path:
    """Write a model file."""
    path = Path(path)
    plain = effects_to_plain(model.effects)
    for one in plain:
        if one["name"] in model.found:
            found = model.found[one["name"]]
            one["found"] = {name: [float(value) for value in pair] for name, pair in found.items()}
    content: dict[str, Any] = {"effects": plain}
    step = {k: v for k, v in asdict(model.step).items() if v != getattr(StepSettings(), k)}
    if step:
        content["step"] = step
    if model.shape != UNCHANGED:
        content["shape"] = model.shape.to_plain()
    if notes:
        content["notes"] = notes
    return write_text(path, to_yaml(content))


def effects_to_plain(effects: Sequence[Effect], fingerprints: bool = False) -> list[dict[str, Any]]:
    """Effects with their priors in plain values, as in a model file.

    With `fingerprints`, what files of effects hold now counts too: reading the effects back
    fails where it has changed.
    """
    plain = [effect_to_plain(effect) for effect in effects]
    for one in plain if fingerprints else []:
        if "file" in one:
            one["sha256"] = file_sha256(Path(one["file"]))
    return plain


def effects_from_plain(plain: Any, path: Path) -> tuple[Effect, ...]:
    """The effects of a model file; raises `ModelError`."""
    if not isinstance(plain, list):
        raise ModelError(path, f"effects is {plain!r}", "expected a list")
    effects = []
    for entry in plain:
        if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
            raise ModelError(path, f"has the effect {entry!r}", "expected at least 'name: ...'")
        if set(entry) - {"name", "file", "parameters", "found", "sha256"}:
            raise ModelError(
                path, f"has the effect {dict(entry)!r}", "expected name, file, parameters and found"
            )
        own: Iterable[Effect] = KNOWN
        if entry.get("file"):
            file = path.parent / str(entry["file"])
            own = load_effects(file)
            if entry.get("sha256") not in (None, file_sha256(file)):
                raise ModelError(file, f"has changed since {path} was made", "estimate again")
        try:
            effect = find_effect(entry["name"], own)
            effects.append(_with_priors(effect, entry.get("parameters") or {}))
        except ValueError as error:
            raise ModelError(path, str(error)) from error
    names = [effect.name for effect in effects]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ModelError(path, f"has the effect {twice[0]!r} twice", "leave one out")
    return tuple(effects)


def _with_priors(effect: Effect, given: Any) -> Effect:
    """The effect with priors replaced by those that are given."""
    if not given:
        return effect
    if not isinstance(given, Mapping):
        raise ValueError(
            f"parameters of {effect.name!r} are {given!r}, expected 'name: [low, high]'"
        )
    if not is_dataclass(effect):
        raise ValueError(f"effect {effect.name!r} is no dataclass; set its priors in its file")
    names = [parameter.name for parameter in effect.parameters]
    for name in given:
        if name not in names:
            raise ValueError(f"effect {effect.name!r} has no {name!r}; expected {', '.join(names)}")
    parameters: list[EffectParameter] = []
    for parameter in effect.parameters:
        ends = given.get(parameter.name)
        if ends is None:
            parameters.append(parameter)
            continue
        try:
            low, high = (float(end) for end in ends)
        except (TypeError, ValueError):
            raise ValueError(
                f"prior of {effect.name}.{parameter.name} is {ends!r}, expected [low, high]"
            ) from None
        what = f"prior of {effect.name}.{parameter.name}"
        _check_unit(parameter, f"{what} is [{low:g}, {high:g}]", low, high)
        if parameter.low == parameter.null and low < parameter.low:
            raise ValueError(f"{what} starts at {low:g}, expected at least {parameter.low:g}")
        parameters.append(replace(parameter, low=low, high=high))
    return replace(effect, parameters=tuple(parameters))  # type: ignore[type-var]


def _check_unit(parameter: EffectParameter, told: str, *values: float) -> None:
    """Refuse sizes [SI units] that are so far beyond the effect's own range that they are in
    another unit; places follow the recording. Raises ValueError."""
    if parameter.where:
        return
    own = max(abs(parameter.low - parameter.null), abs(parameter.high - parameter.null))
    if any(MOST * own < abs(value - parameter.null) < math.inf for value in values):
        raise ValueError(
            f"{told}, expected {parameter.unit}, within {MOST:g} times [{parameter.low:g},"
            f" {parameter.high:g}]"
        )


def _narrowed(
    effect: Effect, found: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Ranges about what was found; where that lies beyond the range of a prior, at its end."""
    ranges = {}
    for parameter in effect.parameters:
        if parameter.name in found:
            mean, std = found[parameter.name]
            reach = max(REACH * std, 1e-3 * (parameter.high - parameter.low))
            middle = min(max(mean, parameter.low), parameter.high)
            ends = middle - reach, middle + reach
            ranges[parameter.name] = max(ends[0], parameter.low), min(ends[1], parameter.high)
    return ranges


def _found_of(plain: Any, effects: Sequence[Effect], path: Path) -> Found:
    """What the entries of a model file say of their effects' sizes; raises `ModelError`."""
    known: dict[str, dict[str, tuple[float, float]]] = {}
    for entry, effect in zip(plain, effects, strict=True):
        given = entry.get("found")
        if given is None:
            continue
        names = [parameter.name for parameter in effect.parameters]
        if not isinstance(given, Mapping) or sorted(given) != sorted(names):
            raise ModelError(
                path, f"found of {effect.name!r} is {given!r}", f"expected {', '.join(names)}"
            )
        known[effect.name] = {}
        for name, pair in given.items():
            try:
                mean, std = (float(value) for value in pair)
            except (TypeError, ValueError):
                mean, std = math.nan, math.nan
            if not (math.isfinite(mean) and 0 <= std < math.inf):
                raise ModelError(
                    path, f"found of {effect.name}.{name} is {pair!r}", "expected [mean, sd >= 0]"
                )
            parameter = effect.parameters[names.index(name)]
            try:
                _check_unit(parameter, f"found of {effect.name}.{name} is {mean:g}", mean)
            except ValueError as error:
                raise ModelError(path, str(error)) from error
            known[effect.name][name] = (mean, std)
    return known
