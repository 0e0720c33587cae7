"""`playbyear-train`: lerobot-train with the dataset in memory.

Takes lerobot-train's options, keeps its output folder and its checkpoints (each resumes the other's), and makes the same
updates. What is added: the dataset is read once, runs of windows are cut out of memory or of files that are mapped into
it, and a GPU never waits for the host.
"""

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from lerobot.configs import parser
from lerobot.datasets import make_train_eval_datasets
from lerobot.utils.constants import ACTION, CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import format_big_number, init_logging, inside_slurm

from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.files import PARTIAL, check_can_be_made, check_no_links, entries_below
from lerobot_playbyear.datasets.reader import DatasetReader, check_dataset_files
from lerobot_playbyear.hub.push import METRICS_NAME, RUN_FOLDERS, PushOptions, check_upload, push_policy
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.batches import Batch, PolicyWindows, learned_meta, make_batches, runs_of_each_frame
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import Learner, make_accelerator, make_learner, noise_seed
from lerobot_playbyear.training.report import Report, is_due, print_results
from lerobot_playbyear.training.store import EpisodeStore

Loss = Callable[[], float]

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
    with errors_of_input(OSError, MemoryError):
        _check(cfg)
        assert isinstance(cfg.policy, PlaybyearConfig)
        accelerator = make_accelerator(cfg.policy)
        if not accelerator.is_main_process:
            logging.getLogger().setLevel(logging.ERROR)
        if cfg.seed is not None:
            set_seed(cfg.seed)
        torch.backends.cudnn.deterministic = cfg.cudnn_deterministic
        torch.backends.cudnn.benchmark = not cfg.cudnn_deterministic
        torch.backends.cuda.matmul.allow_tf32 = True
        with accelerator.main_process_first():  # it downloads, and the others find what is there
            dataset, held_out = make_train_eval_datasets(cfg)
        reader = DatasetReader.of(dataset)
        cfg.policy.fps = cfg.policy.fps or reader.fps
        cfg.steps, cfg.steps_per_episode = max(cfg.steps, cfg.steps_per_episode * dataset.num_episodes), 0
        meta = learned_meta(cfg.policy, reader.meta)
        learner = make_learner(cfg, meta, accelerator=accelerator)
        is_shared = accelerator.num_processes > 1
        if cfg.seed is not None and is_shared:
            set_seed(noise_seed(cfg.seed, accelerator.process_index, learner.step))  # each its own
        windows = PolicyWindows(learner.unwrapped.config, meta, cfg.rename_map)
        store = read_store(reader, windows, cfg, is_shared)
        held_out_loss = None
        if held_out is not None and cfg.eval_steps > 0:
            held_out_loss = _loss_of(DatasetReader.of(held_out), learner, windows, cfg, is_shared)

    learner.warn_of_reach(store.column(ACTION), f"the dataset '{reader.repo_id}'")
    batches = make_batches(accelerator, windows, store, cfg.batch_size, cfg.seed or 0, learner.step)
    n_parameters = format_big_number(sum(p.numel() for p in learner.policy.parameters() if p.requires_grad))
    logging.info(
        f"{n_parameters} parameters on {accelerator.device}, steps {learner.step} to {cfg.steps} of {cfg.batch_size} "
        f"sequences, output in {cfg.output_dir}"
    )
    with Report(cfg, store, learner) as report:
        _loop(cfg, learner, batches, held_out_loss, report)
    if accelerator.is_main_process:
        print_results(cfg, report.success, report.acted_early)
        if cfg.policy.push_to_hub:
            # The last checkpoint is on disk, and stays there.
            folder = str(cfg.output_dir) if cfg.save_checkpoint else learner.save(cfg)
            print(f"On the Hub: {push_policy(folder, str(cfg.policy.repo_id), PushOptions(cfg.policy.private))}")
    accelerator.wait_for_everyone()  # gloo may hang if a group ends while a sum of tensors has just been made
    accelerator.end_training()
    return Path(str(cfg.output_dir))


def _loop(
    cfg: PlaybyearTrainConfig, learner: Learner, batches: Iterator[Batch], held_out_loss: Loss | None, report: Report
) -> None:
    grad_clip_norm = cfg.optimizer.grad_clip_norm if cfg.optimizer is not None else 0.0
    is_first = learner.accelerator.is_main_process
    while learner.step < cfg.steps:
        start = time.perf_counter()
        batch = next(batches)
        waited = time.perf_counter() - start
        report.updated({**learner.update(batch, grad_clip_norm), "dataloading_s": waited})
        step, is_last = learner.step, learner.step == cfg.steps
        if is_due(step, cfg.log_freq):
            report.write_training()
        if not is_first:
            continue
        if held_out_loss is not None and (is_due(step, cfg.eval_steps) or is_last):
            report.write("validation", {"loss": held_out_loss()})
        if cfg.save_checkpoint and (is_due(step, cfg.save_freq) or is_last):
            report.saved(learner.save(cfg))
        if cfg.env is not None and cfg.env_eval_freq > 0 and (is_due(step, cfg.env_eval_freq) or is_last):
            report.write_evaluation(learner.evaluate(cfg))


def _check(cfg: PlaybyearTrainConfig) -> None:
    """Everything that can be told before the dataset is read."""
    output = cfg.output_dir or _OUTPUTS
    check_can_be_made(Path(str(output)), f"--output_dir={output}")
    cfg.validate()
    _check_place(cfg)
    _check_links(Path(str(cfg.output_dir)))
    check_dataset_files(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
    if cfg.policy is None:
        raise ValueError("No policy: give --preset=cpu or gpu, --policy.path, or --policy.type=playbyear.")
    if not isinstance(cfg.policy, PlaybyearConfig):
        raise ValueError(
            f"--policy.type={cfg.policy.type}: playbyear-train trains policies of --policy.type=playbyear alone; give that, "
            "or use lerobot-train."
        )
    if cfg.policy.push_to_hub:
        check_upload("policy.repo_id", str(cfg.policy.repo_id))


def _check_place(cfg: PlaybyearTrainConfig) -> None:
    """Whether a run goes on in its own folder, also where that was moved, or a stranger wrote its options.

    Raises:
        InputError: Its options name another one, and the command line none.
    """
    if not cfg.resume or cfg.checkpoint_path is None or parser.parse_arg("output_dir") is not None:
        return
    run = cfg.checkpoint_path.parent.parent
    if run.resolve() != Path(str(cfg.output_dir)).resolve():
        raise InputError(
            f"The options of the run in '{run}' say --output_dir={cfg.output_dir}, which is another folder. Give "
            f"--output_dir={run} to go on there."
        )


def _check_links(run: Path) -> None:
    """Whether all that a run writes stays in its folder: what resumes may be a stranger's.

    Raises:
        InputError: A link stands there, other than LeRobot's own to the last checkpoint.
    """
    check_no_links(run, METRICS_NAME, *RUN_FOLDERS)
    folders = [run / name for name in (CHECKPOINTS_DIR, "eval") if (run / name).is_dir()]
    there = [path.relative_to(run) for folder in folders for path in entries_below(folder)]
    # PARTIAL: it was killed there.
    own = [Path(CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK + ending) for ending in ("", PARTIAL)]
    check_no_links(run, *(str(path) for path in there if path not in own))


def _loss_of(
    held_out: DatasetReader, learner: Learner, windows: PolicyWindows, cfg: PlaybyearTrainConfig, is_shared: bool
) -> Loss:
    """What gives the mean loss over held-out episodes."""
    store = read_store(held_out, windows, cfg, is_shared)
    runs = runs_of_each_frame(store, windows.n_windows)

    def loss() -> float:
        parts = runs.split(cfg.batch_size)
        return sum(learner.loss(windows.batch(store, last)) * len(last) for last in parts) / len(runs)

    return loss


def read_store(
    reader: DatasetReader, windows: PolicyWindows, cfg: PlaybyearTrainConfig, is_shared: bool = False
) -> EpisodeStore:
    """What a policy learns from, in memory or on the disk.

    Args:
        reader: Of the dataset.
        windows: Say what of it is needed.
        cfg: The options of the run.
        is_shared: Whether several processes read it: files are in memory once, and "auto" takes them.

    Raises:
        ValueError, MemoryError: As `EpisodeStore.from_dataset`.
    """
    start, options = time.perf_counter(), cfg.store
    store = EpisodeStore.from_dataset(
        reader,
        windows.keys,
        options.device,
        progress=not inside_slurm(),
        place="disk" if is_shared and options.place == "auto" else options.place,
        image_size=windows.image_size,
        cache=None if options.cache is None else Path(options.cache),
        sample_rates=windows.sample_rates,
    )
    where = "on the disk" if store.place == "disk" else "in memory"
    logging.info(
        f"{len(store)} frames of {store.n_episodes} episodes {where}, {store.device} ({store.nbytes / 2**20:.0f} MiB) after "
        f"{time.perf_counter() - start:.1f} s"
    )
    return store
