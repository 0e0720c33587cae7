"""The plan: which cells there are, and the commands of each. It is data, `plan.yaml`; here it is read."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import yaml

from lerobot_playbyear.datasets.errors import InputError

Values = Mapping[str, Any]
_MOST_NESTED = 8  # values that name others


@dataclass(frozen=True)
class Step:
    """A command with a folder of its own.

    Args:
        name: What it does, as in the plan.
        folder: What it writes.
        command: As a person would type it, in words.
    """

    name: str
    folder: Path
    command: tuple[str, ...]

    @property
    def shown(self) -> str:
        return shlex.join(self.command)


@dataclass(frozen=True)
class Candidate:
    """A checkpoint that may be the best.

    Args:
        name: Of its folder in `checkpoints`.
        at: How far the run was: kept attempts, or steps.
        path: What is evaluated.
    """

    name: str
    at: int
    path: Path


@dataclass(frozen=True)
class Cell:
    """One policy, or one script, on one task: what a row of the results is about.

    Args:
        study, task, variant, seed, size: Which one.
        values: What its commands are filled with.
    """

    study: str
    task: str
    variant: str
    seed: int
    size: str
    values: Values = field(repr=False, hash=False, compare=False)
    plan: "Plan" = field(repr=False, hash=False, compare=False)

    @property
    def name(self) -> str:
        return f"{self.study}/{self.task}/{self.variant}/seed={self.seed}"

    @property
    def folder(self) -> Path:
        """Of what is its alone: evaluations, films, its lock."""
        return self._below(f"cells/{self.name}")

    def _below(self, name: str) -> Path:
        """A folder of this size: it may be removed, so that nothing else may be it."""
        place = Path(self.size, name)
        if place.is_absolute() or ".." in place.parts or place == Path(self.size):
            raise InputError(f"{self.name}: '{name}' is no folder below {self.plan.output / self.size}.")
        return self.plan.output / place

    @property
    def _course(self) -> list[str]:
        return list(self.plan.text["courses"][self.fill(self.values["course"])])

    def fill(self, text: str, **more: Any) -> str:
        """A text of the plan with this cell's values.

        Raises:
            InputError: It names a value that there is not.
        """
        values = {**self.values, **more}
        for _ in range(_MOST_NESTED):
            try:
                text = Template(text).substitute(values)
            except (KeyError, ValueError) as error:
                raise InputError(f"{self.name}: the plan has no value for {error} in '{text}'.") from error
        return text

    @cached_property
    def steps(self) -> list[Step]:
        """What makes it, before it is evaluated; several cells may share a step."""
        made: dict[str, Any] = {}
        steps = []
        for name in self._course:
            template = self.plan.text["steps"][name]
            folder = self._below(self.fill(template["folder"]))
            made |= {name: folder, f"{name}_last": _policy(folder, "last")}
            steps.append(Step(name, folder, self._words(template["command"], folder=folder, **made)))
        return steps

    @property
    def candidates(self) -> list[Candidate]:
        """The checkpoints that are evaluated, the last one at the end; none of a script."""
        if "record" not in self._course and self._course != ["residual"]:
            return []
        found: list[Candidate] = []
        before, every, updates = 0, int(self.values["every"]), int(self.values["updates"])
        for step in self.steps:
            template = self.plan.text["steps"][step.name]
            if "rounds" not in template:
                continue
            rounds, n_waits = int(self.fill(str(template["rounds"]))), max(int(self.values["warmup"]) - 1 - before, 0)
            for number in range(every, rounds + 1, every):
                if number > n_waits and not self.values.get("only_last"):
                    name = f"{(number - n_waits) * updates:06}"
                    found.append(Candidate(name, before + number, _policy(step.folder, name)))
            before += rounds
        last = self.steps[-1]
        if found and found[-1].at == before:
            found.pop()  # it is the last one
        at = before or int(self.values["rl_steps" if last.name == "residual" else "steps"])
        return [*found, Candidate("last", at, _policy(last.folder, "last"))]

    def evaluation(self, purpose: str, candidate: Candidate) -> Step:
        """How a checkpoint is tried.

        Args:
            purpose: `choice`, or `held_out`.
            candidate: The checkpoint.
        """
        n, stage = int(self.values[f"n_{purpose}"]), candidate.path.parts[-4]
        folder = self.folder / f"{purpose}-{stage}-{candidate.name}"
        values = {"checkpoint": candidate.path, "n_episodes": n, "batch": min(n, 25)}
        kind = "evaluate_residual" if self.steps[-1].name == "residual" else "evaluate"
        return self._step(kind, folder, first_seed=self.values[f"seed_{purpose}"], **values)

    def film(self, mode: str, seed: int) -> Step:
        """A film of an episode that the last checkpoint fails in."""
        values = {"checkpoint": self.candidates[-1].path, "first_seed": seed, "mode": mode}
        return self._step("film", self.folder / "films", **values)

    def _step(self, kind: str, folder: Path, **values: Any) -> Step:
        made = {f"{step.name}_last": _policy(step.folder, "last") for step in self.steps}
        text = self.plan.text["steps"][kind]["command"]
        return Step(kind, folder, self._words(text, folder=folder, **made, **values))

    def _words(self, text: str, **values: Any) -> tuple[str, ...]:
        shared = {name: text for name, text in self.plan.text.items() if isinstance(text, str)}
        own = {**shared, "options": self.plan.text["policies"][self.values["policy"]]}
        later = {name: f"${{{name}}}" for name in values}  # a folder's name is no part of what is split
        words = shlex.split(self.fill(text, **own, **later))
        return tuple(Template(word).safe_substitute(values) for word in words)


class Plan:
    """All cells of a size.

    Args:
        size: One of the plan's.
        output: The folder that commands write into.
        path: Another plan than the package's.
        device: Of training: `cuda`. None: as the plan says.

    Raises:
        InputError: There is no such size, or the file is no plan.
    """

    def __init__(self, size: str, output: Path, path: Path | None = None, device: str | None = None) -> None:
        source = path or files("lerobot_playbyear.reproduce") / "plan.yaml"
        try:
            self.text: dict[str, Any] = yaml.safe_load(source.read_text(encoding="utf-8"))
            known = list(self.text["sizes"])
        except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
            raise InputError(
                f"--plan={path} is no plan: {error}. Copy the package's plan.yaml, and change that."
            ) from error
        if size not in known:
            raise InputError(f"--size={size} is not in the plan: choose from {', '.join(known)}.")
        if twice := set(self.text["sizes"][size]) & set(self.text["steps"]):
            raise InputError(f"--plan={path}: {', '.join(sorted(twice))} is a value and a step: give it another name.")
        self.size, self.output, self.device = size, output, device
        try:
            for cell in self.cells if path else []:
                _ = cell.steps, [cell.evaluation("held_out", candidate) for candidate in cell.candidates]
        except InputError:
            raise
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"--plan={path}: a study, variant, course or step is not built as those of the package's plan.yaml "
                f"({type(error).__name__}: {error}). Compare it with that."
            ) from error

    @cached_property
    def cells(self) -> list[Cell]:
        """In the plan's order: seed by seed, so that what comes first says something of everything."""
        usual, studies = self.text["sizes"][self.size]["seeds"], self.text["studies"].values()
        seeds = sorted({*usual, *(seed for study in studies for seed in study.get("seeds", {}).get(self.size, []))})
        return [cell for seed in seeds for cell in self._cells_of(int(seed), seed == usual[0])]

    def chosen(self, only: str | None) -> list[Cell]:
        """The cells that are asked for.

        Args:
            only: Parts of their names, such as `OccludedGrasp-v1/full/seed=1`, in their order; several with commas between
                them. None: all.

        Raises:
            InputError: No cell has them.
        """
        if not only:
            return self.cells
        found: list[Cell] = []
        for asked in only.split(","):
            matching = [cell for cell in self.cells if _has(cell.name.split("/"), asked.split("/"))]
            if not matching:
                names = sorted({part for cell in self.cells for part in cell.name.split("/")})
                raise InputError(
                    f"--only={asked}: no cell of size {self.size} has these parts. There are {', '.join(names)}."
                )
            found += [cell for cell in matching if cell not in found]
        return found

    def _cells_of(self, seed: int, is_first: bool) -> Iterator[Cell]:
        size = self.text["sizes"][self.size]
        for study, content in self.text["studies"].items():
            seeds = content.get("seeds", {}).get(self.size, size["seeds"])
            if self.size not in content.get("sizes", [self.size]) or seed not in seeds:
                continue
            shared = (self.text["seeds"], self.text["defaults"], size, content.get("values", {}))
            for task, of_task in content["tasks"].items():
                for variant in content["variants"]:
                    named = isinstance(content["variants"], dict)
                    base = self.text["variants"].get(content["variants_of"] if named else variant, {})
                    own = content["variants"][variant] if named else {}
                    values = {key: value for part in (*shared, of_task, base, own) for key, value in part.items()}
                    # Scripts have no seed, and players take hours.
                    if values["course"] in ("scripts", "learned") and not is_first:
                        continue
                    values |= {"task": task, "seed": seed}
                    values["steps"] *= values["steps_factor"]
                    values["rl_steps"] *= values["rl_factor"]
                    for key in size.get("limits", {}).keys() & values.keys():
                        values[key] = min(values[key], size["limits"][key])
                    if self.device:
                        values["training"] += f" --policy.device={self.device}"
                        values["online"] += f" --policy.device={self.device}"
                    yield Cell(study, task, variant, seed, self.size, values, self)


def _has(parts: list[str], asked: list[str]) -> bool:
    """Whether some parts are among others, in their order."""
    rest = iter(parts)
    return all(part in rest for part in asked)


def _policy(run: Path, checkpoint: str) -> Path:
    return run / "checkpoints" / checkpoint / "pretrained_model"
