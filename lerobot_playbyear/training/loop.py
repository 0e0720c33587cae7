"""`playbyear-train`: lerobot-train with the dataset in memory.

Takes lerobot-train's options, keeps its output folder and its checkpoints (each resumes the other's), and makes the same
updates. What is added: the dataset is read once, runs of windows are cut out of memory or of files that are mapped into
it, and a GPU never waits for the host.
"""

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.datasets import LeRobotDataset, make_train_eval_datasets
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import format_big_number, init_logging, inside_slurm
from torch import Tensor

from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.datasets.errors import errors_of_input
from lerobot_playbyear.datasets.files import check_can_be_made
from lerobot_playbyear.datasets.info import check_dataset_files
from lerobot_playbyear.datasets.reading import choose_place
from lerobot_playbyear.datasets.samplers import RunSampler, run_weights
from lerobot_playbyear.hub.push import PushOptions, check_name, push_policy, warn_without_login
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.parts import TrainingParts, make_training_parts, read_recorded_noise
from lerobot_playbyear.training.prefetch import pinned, prefetched
from lerobot_playbyear.training.processes import make_accelerator, noise_seed, share_of
from lerobot_playbyear.training.reach import Reach, action_names
from lerobot_playbyear.training.report import Report, is_due, print_results
from lerobot_playbyear.training.validation import first_of_each_task, validation_loss
from lerobot_playbyear.training.windows import PolicyWindows, learned_meta

if TYPE_CHECKING:
    from accelerate import Accelerator

_OUTPUTS = "outputs/train"  # in which LeRobot makes folders for runs without a name


def train(cfg: PlaybyearTrainConfig) -> Path:
    """Train a policy.

    Args:
        cfg: The options of the run.

    Returns:
        The output folder.

    Raises:
        InputError: If an option, the dataset and the policy do not go together, before any work is done.
        HubError: After it, if the Hub does not take the policy.
    """
    init_logging()
    with errors_of_input(FileNotFoundError, MemoryError):
        output = cfg.output_dir or _OUTPUTS
        check_can_be_made(Path(str(output)), f"--output_dir={output}")
        cfg.validate()
        check_dataset_files(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
        if cfg.policy is not None and cfg.policy.push_to_hub:
            check_name("policy.repo_id", str(cfg.policy.repo_id))
            warn_without_login()
        if cfg.policy is None:
            raise ValueError("No policy: give --policy.type=playbyear, --policy.path or --preset.")
        accelerator = make_accelerator(cfg.policy)
        if not accelerator.is_main_process:
            logging.getLogger().setLevel(logging.ERROR)
        if cfg.seed is not None:
            set_seed(cfg.seed)
        _configure_backends(cfg)
        with accelerator.main_process_first():  # it downloads, and the others find what is there
            dataset, held_out = make_train_eval_datasets(cfg)
        meta = learned_meta(cfg.policy, dataset.meta)
        parts = make_training_parts(cfg, meta, accelerator=accelerator)
        if cfg.seed is not None and accelerator.num_processes > 1:
            set_seed(noise_seed(cfg.seed, accelerator.process_index, parts.step))  # each its own
        policy = accelerator.unwrap_model(parts.policy)
        read_recorded_noise(policy)
        config = policy.config
        windows = PolicyWindows(config, meta, cfg.rename_map)
        is_shared = accelerator.num_processes > 1
        windows.check_lengths(dataset)
        store = read_store(dataset, windows, cfg, is_shared)
        validation = None
        if held_out is not None and cfg.eval_steps > 0:
            chosen = first_of_each_task(held_out, cfg.max_eval_samples)
            validation = (read_store(held_out, windows, cfg, is_shared), chosen)

    reach = Reach(config, parts.preprocessor, action_names(dataset.meta.features[ACTION]))
    reach.warn(store.column(ACTION), f"the dataset '{dataset.repo_id}'")
    weights = run_weights(store, windows.n_windows, n_dropped=windows.n_dropped)
    sampler = RunSampler(weights, cfg.seed or 0)
    sampler.load_state_dict({**sampler.state_dict(), "n_batches": parts.step})
    _log_start(cfg, parts)
    with Report(cfg, store, parts) as report:
        _loop(cfg, parts, windows, store, sampler, validation, report)
    if accelerator.is_main_process:
        print_results(cfg, report.success)
        if cfg.policy.push_to_hub:
            _push(cfg, parts)
    accelerator.wait_for_everyone()  # gloo may hang if a group ends while a sum of tensors has just been made
    accelerator.end_training()
    return Path(str(cfg.output_dir))


def _loop(
    cfg: PlaybyearTrainConfig,
    parts: TrainingParts,
    windows: PolicyWindows,
    store: EpisodeStore,
    sampler: RunSampler,
    validation: tuple[EpisodeStore, Tensor | None] | None,
    report: Report,
) -> None:
    grad_clip_norm = cfg.optimizer.grad_clip_norm if cfg.optimizer is not None else 0.0
    accelerator = parts.accelerator
    is_first = accelerator.is_main_process
    batches = _batches(cfg, accelerator, windows, store, sampler)
    while parts.step < cfg.steps:
        start = time.perf_counter()
        batch = next(batches)
        waited = time.perf_counter() - start
        report.updated({**parts.update(batch, grad_clip_norm), "dataloading_s": waited})
        is_last = parts.step == cfg.steps
        if is_due(parts.step, cfg.log_freq):
            report.write_training()
        is_saved = cfg.save_checkpoint and (is_due(parts.step, cfg.save_freq) or is_last)
        is_measured = is_due(parts.step, cfg.eval_steps) or is_last
        if validation is not None and is_first and is_measured:
            held_out, chosen = validation
            report.write("validation", {"loss": validation_loss(parts, windows, held_out, cfg.batch_size, chosen)})
        if is_saved and is_first:
            report.saved(parts.save(cfg))
        is_tried = cfg.env is not None and cfg.env_eval_freq > 0 and is_first
        if is_tried and (is_due(parts.step, cfg.env_eval_freq) or is_last):
            report.write_evaluation(parts.evaluate(cfg))


def _batches(
    cfg: PlaybyearTrainConfig,
    accelerator: "Accelerator",
    windows: PolicyWindows,
    store: EpisodeStore,
    sampler: RunSampler,
) -> Iterator[dict[str, Any]]:
    """This process's share of every batch. All draw the same runs, so that together they have those of one process."""
    n_runs = cfg.batch_size * accelerator.num_processes
    share = share_of(accelerator, n_runs)

    def cut() -> dict[str, Any]:
        return windows.batch(store, sampler.draw(n_runs)[share])

    if accelerator.device.type == "cuda" and store.device.type == "cpu":
        return prefetched(lambda: pinned(cut()))
    return iter(cut, None)


def read_store(
    dataset: LeRobotDataset, windows: PolicyWindows, cfg: PlaybyearTrainConfig, is_shared: bool = False
) -> EpisodeStore:
    """What a policy learns from, in memory or on the disk.

    Args:
        dataset: The dataset.
        windows: Say what of it is needed.
        cfg: The options of the run.
        is_shared: Whether several processes read it: files are in memory once, and "auto" takes them.

    Raises:
        ValueError, MemoryError: As `EpisodeStore.from_dataset`.
    """
    start = time.perf_counter()
    options = cfg.store
    wanted = "disk" if is_shared and options.place == "auto" else options.place
    place = choose_place(wanted, dataset, windows.keys, windows.sample_rates)
    store = EpisodeStore.from_dataset(
        dataset,
        windows.keys,
        options.device,
        cfg.dataset.video_backend,
        progress=not inside_slurm(),
        place=place,
        image_size=windows.image_size,
        cache=None if options.cache is None else Path(options.cache),
        sample_rates=windows.sample_rates,
    )
    where = f"on the disk, {store.device}" if place == "disk" else f"in memory, {store.device}"
    logging.info(
        f"{len(store)} frames of {store.n_episodes} episodes {where} ({store.nbytes / 2**20:.0f} MiB) after "
        f"{time.perf_counter() - start:.1f} s"
    )
    return store


def _configure_backends(cfg: PlaybyearTrainConfig) -> None:
    torch.backends.cudnn.deterministic = cfg.cudnn_deterministic
    torch.backends.cudnn.benchmark = not cfg.cudnn_deterministic
    torch.backends.cuda.matmul.allow_tf32 = True


def _log_start(cfg: PlaybyearTrainConfig, parts: TrainingParts) -> None:
    n_parameters = sum(p.numel() for p in parts.policy.parameters() if p.requires_grad)
    logging.info(
        f"{format_big_number(n_parameters)} parameters on {parts.accelerator.device}, steps {parts.step} to {cfg.steps} "
        f"of {cfg.batch_size} runs, output in {cfg.output_dir}"
    )


def _push(cfg: PlaybyearTrainConfig, parts: TrainingParts) -> None:
    """Uploads the last checkpoint, which is on disk and stays there."""
    assert cfg.policy is not None
    assert cfg.policy.repo_id is not None
    folder = (Path(str(cfg.output_dir)) / "checkpoints" / "last") if cfg.save_checkpoint else parts.save(cfg)
    url = push_policy(folder / "pretrained_model", cfg.policy.repo_id, PushOptions(cfg.policy.private))
    print(f"On the Hub: {url}")
