"""Whether windows that share encodings teach as much as windows that do not: the same number of windows, K per run.

    python -m experiments.run_length --jobs=2

Every update supervises 64 windows: of 64 runs (K = 1, as in the paper), of 8 (K = 8), or of 4 (K = 16). Beside the success
stands the loss on demonstrations that no training saw, and the minutes. A small budget, so that K = 1 is done in 10 minutes;
the figures compare, and say nothing about what a policy can reach.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors

from experiments.protocol import (
    N_DEMONSTRATIONS,
    RESULTS,
    RUN_LENGTHS,
    Result,
    command_line,
    dataset_root,
    load,
    record,
    save,
)
from experiments.training import Job, train_and_evaluate
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.training import EpisodeStore
from lerobot_playbyear.training.batches import PolicyWindows

STUDY = "run_length"
N_WINDOWS = 64  # per update
STEPS = 600
N_RECORDED = 100  # what is recorded beyond the demonstrations is held out


def job_of(task: str, run_length: int, seed: int) -> Job:
    options = (f"--policy.n_supervised_steps={run_length}", f"--batch_size={N_WINDOWS // run_length}")
    return Job(STUDY, task, "full", seed, steps=STEPS, options=options, variant=f"k{run_length}")


@torch.no_grad()
def held_out_loss(job: Job) -> float:
    """The mean squared error over the held-out demonstrations, as in a rollout: float32, no augmentation."""
    policy = PlaybyearPolicy.from_pretrained(job.checkpoint).eval()
    preprocessor, _ = make_pre_post_processors(policy.config, pretrained_path=str(job.checkpoint))
    episodes = list(range(N_DEMONSTRATIONS, N_RECORDED))
    dataset = LeRobotDataset(f"experiments/{job.task}", root=dataset_root(job.task), episodes=episodes)
    policy.config.n_supervised_steps = 1  # every frame once
    windows = PolicyWindows(policy.config, dataset.meta)
    store = EpisodeStore.from_dataset(dataset, windows.keys)
    losses = []
    for part in np.array_split(np.arange(len(store)), max(1, len(store) // 256)):
        batch = preprocessor(windows.batch(store, torch.from_numpy(part)))
        losses.append(len(part) * float(policy.forward(batch)[0]))
    return float(sum(losses) / len(store))


def study(job: Job) -> tuple[Result, float]:
    """Trains, evaluates, and keeps the figures: success and minutes, and the loss on held-out demonstrations."""
    result = train_and_evaluate(job)
    path = RESULTS / STUDY / "held_out_loss" / f"{job.name}.json"
    if not path.exists():
        save(path, held_out_loss(job))
    return result, load(path)


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "jobs")
    parser.add_argument("--run_lengths", nargs="+", type=int, default=RUN_LENGTHS)
    options = parser.parse_args()
    record(options.task, N_RECORDED)
    jobs = [job_of(options.task, length, seed) for seed in options.seeds for length in options.run_lengths]
    with ThreadPoolExecutor(options.jobs) as pool:
        for job, (result, loss) in zip(jobs, pool.map(study, jobs), strict=True):
            print(f"{job.name}: {result.rate:.0%}, held-out loss {loss:.4f}, {result.minutes} min", flush=True)


if __name__ == "__main__":
    main()
