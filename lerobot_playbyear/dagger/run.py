"""A run of HG-DAgger from its options: what it needs is made and checked, then `Loop` runs."""

import logging
import os
import shlex
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot.utils.utils import init_logging

from lerobot_playbyear.dagger.attempt import Scene
from lerobot_playbyear.dagger.batches import BalancedBatches, frames_by_expert
from lerobot_playbyear.dagger.checks import (
    check_action_range,
    check_actions_can_be_masked,
    check_alike,
    check_dataset,
    check_expert,
    check_places,
)
from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.figures import Totals
from lerobot_playbyear.dagger.folder import RunFolder, RunState
from lerobot_playbyear.dagger.helpers import help_to_learn, is_first_process
from lerobot_playbyear.dagger.loop import Loop
from lerobot_playbyear.dagger.methods import Tools
from lerobot_playbyear.dagger.methods.base import Method
from lerobot_playbyear.dagger.methods.beside import Early, shifted
from lerobot_playbyear.dagger.new_weights import forget_all
from lerobot_playbyear.dagger.report import Report
from lerobot_playbyear.dagger.same_run import differences
from lerobot_playbyear.dagger.weighted_batches import WeightedBatches
from lerobot_playbyear.datasets import EpisodeStore, check_dataset_files
from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.episodes.environment import env_facts, env_spec
from lerobot_playbyear.episodes.frames import dataset_features, next_seed
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.hub.push import METRICS_NAME, PushOptions, check_name, push_policy, warn_without_login
from lerobot_playbyear.training.checkpoints import BEST_LINK
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.loop import read_store
from lerobot_playbyear.training.parts import make_training_parts, read_recorded_noise
from lerobot_playbyear.training.processes import Orders, share_of
from lerobot_playbyear.training.reach import Reach, action_names
from lerobot_playbyear.training.windows import PolicyWindows, dataset_names


def run_dagger(cfg: DaggerConfig) -> Path:
    """Improve a policy with an expert's corrections.

    Args:
        cfg: The options.

    Returns:
        The output folder.

    Raises:
        InputError: If options, policy, data and environment do not go together, before any work is done.
        PlaybyearError: If the run cannot go on. What was saved before is safe.
    """
    init_logging()
    logging.getLogger("lerobot.configs.video").setLevel(
        logging.WARNING
    )  # it has a line for every attempt that is saved
    with ExitStack() as stack:
        with errors_of_input(FileNotFoundError, MemoryError):
            cfg.check()
            check_places(cfg)
            folder = RunFolder(cfg.output_dir)
            if is_first_process():
                stack.callback(folder.lock().release)
            state = _begin_or_go_on(cfg, folder, folder.claim(cfg.resume))
            if not is_first_process():
                help_to_learn(cfg, _training_options(cfg, folder, state))
                return folder.path
            loop = _make_loop(cfg, folder, state, stack)
        loop.run()
    _print_results(cfg, folder, state, loop)
    if cfg.policy is not None and cfg.policy.push_to_hub and state.checkpoint is not None:
        assert cfg.policy.repo_id is not None
        checkpoint = folder.checkpoints / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
        print(f"On the Hub:  {push_policy(checkpoint, cfg.policy.repo_id, PushOptions(cfg.policy.private))}")
    return folder.path


def _begin_or_go_on(cfg: DaggerConfig, folder: RunFolder, state: RunState | None) -> RunState:
    """The state of a run that goes on, or of a new one; and the policy's configuration, which goes into `cfg`."""
    given = parser.get_path_arg("policy")
    if given is None and cfg.policy is not None and cfg.policy.pretrained_path:
        given = str(cfg.policy.pretrained_path)
    given = given and _followed(given)
    overrides = [*parser.get_yaml_overrides("policy"), *(parser.get_cli_overrides("policy") or [])]  # the last one wins
    if state is None:
        if given is None:
            raise InputError(
                "HG-DAgger improves a trained policy: give its folder or its name on the Hub, --policy.path."
            )
        if (folder.path / CONFIG_NAME).is_file():
            logging.info(f"{folder.path}: the run was ended before its first attempt and begins anew.")
        state = RunState(policy_path=given, policy_overrides=overrides, first_episodes=None)
    else:
        changed = differences(folder.path, cfg)
        if given is not None and given != _followed(state.policy_path):
            changed.append(f"--policy.path was {state.policy_path} and is {given}")
        if changed:
            raise InputError(
                f"--output_dir={folder.path} holds another run: {'; '.join(changed)}. Leave these options out to go on "
                "with it, or choose another folder."
            )
    checkpoint = folder.checkpoint(state)
    source = state.policy_path if checkpoint is None else str(checkpoint / PRETRAINED_MODEL_DIR)
    if checkpoint is None and overrides != state.policy_overrides:
        overrides = state.policy_overrides = [*state.policy_overrides, *overrides]
    cfg.policy = PreTrainedConfig.from_pretrained(source, cli_overrides=overrides)
    cfg.policy.pretrained_path = source  # type: ignore[assignment]
    if overrides:
        check_action_range(cfg.policy, PreTrainedConfig.from_pretrained(source))
    if cfg.policy.push_to_hub and not cfg.policy.repo_id:
        raise InputError(
            "--policy.push_to_hub=true needs a name: give --policy.repo_id, or --policy.push_to_hub=false."
        )
    if cfg.policy.push_to_hub:
        check_name("policy.repo_id", str(cfg.policy.repo_id))
        warn_without_login()
    return state


def _followed(policy: str) -> str:
    """A policy's folder itself where a link names it, such as `checkpoints/last`, which names another one tomorrow."""
    if not os.path.isdir(policy):  # a name on the Hub
        return policy
    folder = os.path.realpath(policy)
    return folder if os.path.isabs(policy) else os.path.relpath(folder)


def _make_loop(cfg: DaggerConfig, folder: RunFolder, state: RunState, stack: ExitStack) -> Loop:
    """What the run needs, checked; `stack` closes it."""
    assert cfg.policy is not None
    check_dataset_files(cfg.demos.repo_id, cfg.demos.root)
    demos = LeRobotDataset(cfg.demos.repo_id, root=cfg.demos.root, video_backend=cfg.demos.video_backend)
    check_dataset(cfg.policy, demos.meta, cfg.rename_map)
    method = cfg.method.make(cfg)
    stack.callback(method.close)
    env = expert = facts = None
    if cfg.is_online and cfg.env is not None:
        env = env_spec(cfg.env).make()
        stack.callback(env.close)
        expert = cfg.expert.make(env)
        stack.callback(expert.close)
        check_expert(cfg, expert)
        on_time = shifted(expert, cfg.takeover_delay_s, env_facts(env).fps, env)
        expert = method.beside(on_time)
    corrections = Corrections(cfg.interventions)
    stack.callback(corrections.close)
    observed = list(dataset_names(cfg.policy, cfg.rename_map).values())
    if env is not None and cfg.env is not None:
        facts = env_facts(env)
        features = method.features(dataset_features(facts))
        check_alike(observed, demos.meta, features, facts.fps, f"--env.type={cfg.env.type}")
        corrections.open_for_writing(facts.fps, features, cfg.env.type)
    else:
        check_alike(observed, demos.meta, corrections.meta.features, corrections.meta.fps, "the corrections")
    if state.first_episodes is None:
        state.first_episodes = corrections.n_episodes
        state.next_seed = next_seed(cfg.interventions.folder, cfg.episode_seed) if cfg.is_online else 0
    _check_there_is_something_to_do(cfg, state, corrections)

    training = _training_options(cfg, folder, state)
    parts = make_training_parts(training, demos.meta, keep_normalization=True)
    share_of(parts.accelerator, cfg.batch_size)
    if cfg.new_weights and state.checkpoint is None:
        forget_all(parts, cfg.seed)
    orders = Orders(parts.accelerator)
    stack.callback(orders.end)
    read_recorded_noise(parts.accelerator.unwrap_model(parts.policy))
    windows = PolicyWindows(cfg.policy, demos.meta, cfg.rename_map)
    demonstrations = read_store(demos, windows, training)
    check_actions_can_be_masked(parts, windows, demonstrations)
    corrections.read(windows.keys, demonstrations.device, demonstrations.image_size)
    reach = Reach(cfg.policy, parts.preprocessor, action_names(demos.meta.features[ACTION]))
    reach.warn(demonstrations.column(ACTION), "the demonstrations")
    if corrections.store is not None:
        reach.warn(corrections.store.column(ACTION)[frames_by_expert(corrections.store)], "the corrections")
    batches = _make_batches(cfg, method, windows, demonstrations, corrections)

    method.begin(Tools(cfg, folder, state, parts, windows, demonstrations, corrections, facts))
    folder.begin(cfg, state)
    report = stack.enter_context(Report(cfg, training, folder, state))
    scene = None
    if env is not None and cfg.env is not None and expert is not None:
        policy = parts.accelerator.unwrap_model(parts.policy)
        actor = PolicyActor(policy, cfg.env, parts.preprocessor, parts.postprocessor, parts.accelerator.autocast)
        scene = Scene(env, actor, expert, on_time if isinstance(on_time, Early) else None)
    return Loop(
        cfg, training, folder, state, parts, demonstrations, corrections, batches, orders, reach, report, scene, method
    )


def _make_batches(
    cfg: DaggerConfig, method: Method, windows: PolicyWindows, demonstrations: EpisodeStore, corrections: Corrections
) -> BalancedBatches:
    if not method.weighs_frames:
        n_skipped = cfg.n_skipped(demonstrations.fps)
        return BalancedBatches(windows, demonstrations, corrections.store, cfg.batch_size, cfg.seed, n_skipped)
    learned = partial(method.learned, len(demonstrations))
    return WeightedBatches(windows, demonstrations, corrections.store, cfg.batch_size, cfg.seed, learned)


def _training_options(cfg: DaggerConfig, folder: RunFolder, state: RunState) -> PlaybyearTrainConfig:
    training = cfg.training()
    training.resume, training.checkpoint_path = state.checkpoint is not None, folder.checkpoint(state)
    return training


def _check_there_is_something_to_do(cfg: DaggerConfig, state: RunState, corrections: Corrections) -> None:
    if not cfg.is_online and corrections.n_episodes == 0:
        raise InputError(
            f"The intervention dataset '{cfg.interventions.repo_id}' is empty: collect attempts with --episodes, or give one "
            "that holds some."
        )
    n_before = state.first_episodes or 0  # one more may be there, of a run that was killed before it counted
    if cfg.is_online and state.kept == 0 and n_before >= cfg.episodes:
        raise InputError(
            f"The intervention dataset holds {n_before} attempts already, and --episodes={cfg.episodes} asks for "
            "no more: give a larger number, or --episodes=0 --updates=N to learn from what is there."
        )


def _print_results(cfg: DaggerConfig, folder: RunFolder, state: RunState, loop: Loop) -> None:
    print(f"\nFigures:     {folder.path / METRICS_NAME}")
    if cfg.is_online:
        print(
            f"Attempts:    {state.attempts}: {state.kept} kept in {cfg.interventions.folder}, {state.failed} failed, "
            f"{state.unneeded} needed no help, {state.discarded} thrown away"
        )
        totals = Totals.of(folder.metrics())
        print(
            f"Expert:      {totals.expert_steps} steps in {totals.takeovers} takeovers, {totals.switches} context switches, "
            f"autonomy {totals.autonomy:.0%}, {totals.person_seconds / 60:.1f} minutes of a person's time"
        )
    n_learned, n_corrected = loop.batches.n_expert_frames()
    skipped_s = cfg.n_skipped(loop.demonstrations.fps) / loop.demonstrations.fps
    left_out = (
        f"; the first {skipped_s:g} s of every correction are left out (--skip_s)" if n_learned < n_corrected else ""
    )
    n_without, n_attempts = loop.batches.n_attempts_without()
    if n_without:
        left_out += f", and with that all of {n_without} of {n_attempts} attempts, whose corrections are shorter"
    print(f"Corrections: {n_learned} of {n_corrected} frames that the expert chose are learned from{left_out}")
    if state.success is not None:
        is_older = state.evaluated_round != state.round
        when = f", after {state.evaluated_round} of {state.round} rounds" if is_older else ""
        print(f"Success:     {state.success:.1f} % of {state.evaluated_episodes or cfg.eval.n_episodes} episodes{when}")
    is_better = state.success is not None and state.best and state.best["success"] > state.success
    if is_better and state.best["seeds"] == [cfg.seed, cfg.eval.n_episodes]:
        best = folder.checkpoints / BEST_LINK / PRETRAINED_MODEL_DIR if state.best["checkpoint"] else state.policy_path
        print(f"Best:        {state.best['success']:.1f} % of them: {best}")
        print("             The best of several evaluations looks better than it is: evaluate it on other seeds, too.")
    more = "episodes" if cfg.is_online else "updates"
    go_on = f"Go on:       playbyear-dagger --resume=true --output_dir={folder.path} --{more}=..."
    if state.checkpoint is None:
        print(f"No update was made: {_why_none(cfg, state)}.\n{go_on}")
        return
    policy = folder.checkpoints / "last" / PRETRAINED_MODEL_DIR
    env = " --env.type=..."
    if cfg.env is not None:
        env = f" --env.type={cfg.env.type} --env.task={shlex.quote(str(cfg.env.task))}"
    print(f"Policy:      {policy}")
    print(f"Evaluate:    lerobot-eval --policy.path={policy}{env}")
    print(go_on)


def _why_none(cfg: DaggerConfig, state: RunState) -> str:
    if state.kept == 0:
        return "no attempt was kept"
    if cfg.updates_per_episode == 0:
        return (
            "--updates_per_episode=0. To learn from all attempts give --episodes=0 --updates=N and another --output_dir"
        )
    return f"--warmup_episodes={cfg.warmup_episodes} is more than the dataset holds"
