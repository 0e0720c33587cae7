"""A run of HG-DAgger from its options: what it needs is made and checked, then `Loop` runs."""

import logging
import os
import shlex
from contextlib import ExitStack
from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.constants import ACTION, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.checks import (
    check_action_range,
    check_alike,
    check_dataset,
    check_expert,
    check_places,
    check_policy,
)
from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.loop import Loop, Scene
from lerobot_playbyear.dagger.report import Report, Totals
from lerobot_playbyear.dagger.run_folder import BEST_LINK, RunFolder, RunState
from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.episodes.environment import env_facts, env_spec
from lerobot_playbyear.episodes.frames import dataset_features, next_seed
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.hub.push import METRICS_NAME, PushOptions, check_name, push_policy, warn_without_login
from lerobot_playbyear.training.batches import PolicyWindows, dataset_names
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import Learner, make_learner
from lerobot_playbyear.training.train import read_store


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
            stack.enter_context(folder.locked())
            state = _begin_or_go_on(cfg, folder, folder.claim(cfg.resume))
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
        changed = folder.differences(cfg)
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
    check_policy(cfg.policy)
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
    demos = DatasetReader(cfg.demos.repo_id, cfg.demos.root)
    check_dataset(cfg.policy, demos.meta, cfg.rename_map)
    method = cfg.method.make()
    stack.callback(method.close)
    env = expert = None
    if cfg.is_online and cfg.env is not None:
        env = env_spec(cfg.env).make()
        stack.callback(env.close)
        expert = cfg.expert.make(env)
        stack.callback(expert.close)
        check_expert(cfg, expert)
        expert = method.beside(expert)
    corrections = Corrections(cfg.interventions)
    stack.callback(corrections.close)
    if env is not None and cfg.env is not None:
        facts = env_facts(env)
        features, fps, what = dataset_features(facts), facts.fps, f"--env.type={cfg.env.type}"
    else:
        features, fps, what = corrections.meta.features, corrections.meta.fps, "the corrections"
    check_alike(dataset_names(cfg.policy, cfg.rename_map).values(), demos.meta, features, fps, what)

    training = _training_options(cfg, folder, state)
    learner = make_learner(training, demos.meta, keep_normalization=True)
    if cfg.new_weights and state.checkpoint is None:
        _forget_all(learner, cfg.seed)
    if env is not None and cfg.env is not None:
        corrections.open_for_writing(fps, features, cfg.env.type)
    if state.first_episodes is None:
        state.first_episodes = corrections.n_episodes
        state.next_seed = next_seed(cfg.interventions.folder, cfg.episode_seed) if cfg.is_online else 0
    _check_there_is_something_to_do(cfg, state, corrections)
    windows = PolicyWindows(cfg.policy, demos.meta, cfg.rename_map)
    demonstrations = read_store(demos, windows, training)
    corrections.read(windows.keys or [], demonstrations.device, demonstrations.image_size)
    learner.warn_of_reach(demonstrations.column(ACTION), "the demonstrations")
    if corrections.store is not None:
        learner.warn_of_reach(corrections.store.column(ACTION)[frames_by_expert(corrections.store)], "the corrections")
    batches = method.batches(cfg, windows, demonstrations, corrections.store)

    folder.begin(cfg, state)
    report = stack.enter_context(Report(cfg, training, folder, state))
    scene = None
    if env is not None and cfg.env is not None and expert is not None:
        actor = PolicyActor(
            learner.unwrapped, cfg.env, learner.preprocessor, learner.postprocessor, learner.accelerator.autocast
        )
        scene = Scene(env, actor, expert)
    return Loop(
        cfg, training, folder, state, learner, windows, demonstrations, corrections, batches, report, scene, method
    )


@torch.no_grad()
def _forget_all(learner: Learner, seed: int) -> None:
    """Gives a policy the weights of one that was just made; what its inputs are normalised with stays, of sound too."""
    policy = learner.unwrapped
    set_seed(seed)
    fresh = type(policy)(policy.config).state_dict()
    kept = [f"{name}." for name, module in policy.named_modules() if getattr(module, "keeps_statistics", False)]
    weights = policy.state_dict()
    for name, values in fresh.items():
        if not any(name.startswith(prefix) for prefix in kept):
            weights[name].copy_(values)


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
    _print_what_is_learned(cfg, loop)
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


def _print_what_is_learned(cfg: DaggerConfig, loop: Loop) -> None:
    store = loop.corrections.store
    if store is None:
        return
    by_expert, is_learned = frames_by_expert(store), loop.batches.is_learned(store)
    text = f"{int(is_learned.sum())} of {int(by_expert.sum())} frames that the expert chose are learned from"
    if int(is_learned.sum()) < int(by_expert.sum()):
        skipped_s = cfg.n_skipped(store.fps) / store.fps
        text += f"; the first {skipped_s:g} s of every correction are left out (--skip_s)"
    spans = [slice(start, end) for start, end in zip(store.starts, store.ends, strict=True)]
    n_without = sum(bool(by_expert[span].any() and not is_learned[span].any()) for span in spans)
    if n_without:
        text += f", and with that all of {n_without} of {len(spans)} attempts, whose corrections are shorter"
    print(f"Corrections: {text}")


def _why_none(cfg: DaggerConfig, state: RunState) -> str:
    if state.kept == 0:
        return "no attempt was kept"
    if cfg.updates_per_episode == 0:
        return (
            "--updates_per_episode=0. To learn from all attempts give --episodes=0 --updates=N and another --output_dir"
        )
    return f"--warmup_episodes={cfg.warmup_episodes} is more than the dataset holds"
