"""What `playbyear-reproduce` can be told."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_playbyear.datasets.errors import InputError

ACTIONS = ("plan", "run", "status", "report", "merge")


@dataclass
class ReproduceConfig:
    """Options of `playbyear-reproduce plan | run | status | report | merge FOLDER`.

    Attributes:
        action: `plan` prints the commands and their cost, `run` does what is missing, `status` counts, `report` writes pages,
            `merge FOLDER` takes in another machine's tables.
        folder: Of `merge`.
        size: `smoke`, `cpu`, `gpu` or `paper`, or another one of the plan.
        only: Parts of names of cells, such as `OccludedGrasp-v1/full/seed=1`; several with commas. None: all cells.
        jobs: Cells that are done side by side.
        threads: Of each command.
        device: Of training: `cuda`. None: the preset's. A cell counts as the same, whatever made it.
        output_dir: Folder of datasets, checkpoints, evaluations, films and pages.
        results: Folder of the tables.
        plan: Another plan, a YAML file like `lerobot_playbyear/reproduce/plan.yaml`. None: that one.
        cluster: `slurm` submits every cell as a job, `local` starts a process for each (both by submitit, the extra `cluster`).
            None: forks of this process.
        partition, minutes: Of the jobs of `slurm`: their queue, and their limit of time.
    """

    action: str
    folder: Path | None = None
    size: str = "cpu"
    only: str | None = None
    jobs: int = 1
    threads: int = 1
    device: str | None = None
    output_dir: Path = Path("outputs/reproduce")
    results: Path = Path("results")
    plan: Path | None = None
    cluster: str | None = None
    partition: str | None = None
    minutes: int = 600

    def check(self) -> None:
        """Raise a InputError if an option has no meaning."""
        if self.action not in ACTIONS:
            raise InputError(f"'{self.action}' is no action: choose from {', '.join(ACTIONS)}.")
        for name in ("jobs", "threads", "minutes"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}={getattr(self, name)}: give 1 or more.")
        if (self.folder is None) == (self.action == "merge"):
            raise InputError("playbyear-reproduce merge FOLDER takes in a folder's tables; no other action has one.")
        if self.cluster not in (None, "local", "slurm"):
            raise InputError(f"--cluster={self.cluster}: give local or slurm, or leave it out.")
