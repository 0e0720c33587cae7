"""A run of HG-DAgger from its options: what it needs is made and checked, then `Loop` runs."""

import logging
import os
import shlex
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PreTrainedConfig, parser
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.loop import Loop, Scene
from lerobot_playbyear.dagger.report import Report
from lerobot_playbyear.dagger.run_folder import BEST_LINK, RunFolder, RunState
from lerobot_playbyear.datasets.errors import InputError, errors_of_input, printable
from lerobot_playbyear.datasets.features import Features, differences
from lerobot_playbyear.datasets.reader import DatasetPlace, DatasetReader
from lerobot_playbyear.episodes.environment import env_facts, env_spec
from lerobot_playbyear.episodes.experts import Expert, ExpertError
from lerobot_playbyear.episodes.frames import dataset_features, next_seed
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.hub.push import METRICS_NAME, PushOptions, check_upload, push_policy
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.batches import PolicyWindows, dataset_names
from lerobot_playbyear.training.learner import Learner, check_dataset_suits, make_learner
from lerobot_playbyear.training.report import evaluation_command
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
    logging.getLogger("lerobot.configs.video").setLevel(logging.WARNING)  # a line for every attempt that is saved
    with ExitStack() as stack:
        with errors_of_input(FileNotFoundError, MemoryError):
            cfg.check()
            _check_places(cfg)
            folder = RunFolder(cfg.output_dir)
            stack.enter_context(folder.locked())
            state = _begin_or_go_on(cfg, folder, folder.claim(cfg.resume, cfg.interventions.folder))
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
            raise InputError("HG-DAgger improves a trained policy: give its folder or name on the Hub, --policy.path.")
        if (folder.path / CONFIG_NAME).is_file():
            logging.info(f"{folder.path}: the run was ended before its first attempt and starts again.")
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
        attempts, n_known = cfg.interventions.folder, (state.first_episodes or 0) + state.kept
        if cfg.is_online and n_known and not any(os.path.exists(attempts / name) for name in ("meta", "data")):
            raise InputError(
                f"There is no dataset in {attempts}, and {n_known} attempts should be there. Is its disk mounted? Mount it, or "
                "put the dataset back from a copy."
            )
    checkpoint = folder.checkpoint(state)
    source = state.policy_path if checkpoint is None else str(checkpoint / PRETRAINED_MODEL_DIR)
    if checkpoint is None and overrides != state.policy_overrides:
        overrides = state.policy_overrides = [*state.policy_overrides, *overrides]
    cfg.policy = PreTrainedConfig.from_pretrained(source, cli_overrides=overrides)
    cfg.policy.pretrained_path = source  # type: ignore[assignment]
    _check_policy(cfg.policy)
    if overrides:
        _check_action_range(cfg.policy, PreTrainedConfig.from_pretrained(source), cfg.dataset)
    if cfg.policy.push_to_hub and not cfg.policy.repo_id:
        raise InputError("--policy.push_to_hub=true needs a name: give --policy.repo_id, or push_to_hub=false.")
    if cfg.policy.push_to_hub:
        check_upload("policy.repo_id", str(cfg.policy.repo_id))
    return state


def _followed(policy: str) -> str:
    """A policy's folder itself where a link names it, such as `checkpoints/last`, which names another one tomorrow."""
    if not os.path.isdir(policy):  # a name on the Hub
        return policy
    folder = os.path.realpath(policy)
    return folder if os.path.isabs(policy) else os.path.relpath(folder)


def _make_loop(cfg: DaggerConfig, folder: RunFolder, state: RunState, stack: ExitStack) -> Loop:
    """What the run needs, checked; `stack` closes it."""
    assert isinstance(cfg.policy, PlaybyearConfig)
    demos = DatasetReader(cfg.dataset.repo_id, cfg.dataset.root)
    _check_dataset(cfg.policy, demos.meta, cfg.rename_map)
    method = cfg.method
    stack.callback(method.close)
    corrections = Corrections(cfg.interventions)
    stack.callback(corrections.close)
    env = scene = None
    if cfg.is_online and cfg.env is not None:
        env = env_spec(cfg.env).make()
        stack.callback(env.close)
        expert = cfg.expert.make(env)
        stack.callback(expert.close)
        _check_expert(cfg, expert)
        expert = method.wrap(expert)
        facts = env_facts(env)
        features, fps, what = dataset_features(facts), facts.fps, f"--env.type={cfg.env.type}"
    else:
        features, fps, what = corrections.meta.features, corrections.meta.fps, "the corrections"
    _check_alike(dataset_names(cfg.policy, cfg.rename_map).values(), demos.meta, features, fps, what)

    training = cfg.training()
    training.resume, training.checkpoint_path = state.checkpoint is not None, folder.checkpoint(state)
    learner = make_learner(training, demos.meta, keep_normalization=True)
    if cfg.new_weights and state.checkpoint is None:
        _forget_all(learner, cfg.seed)
    if env is not None and cfg.env is not None:
        corrections.open_for_writing(fps, features, cfg.env.type)
        processors = (learner.preprocessor, learner.postprocessor)
        scene = Scene(env, PolicyActor(learner.unwrapped, cfg.env, *processors, learner.accelerator.autocast), expert)
    if state.first_episodes is None:
        state.first_episodes = corrections.n_episodes
        state.next_seed = next_seed(cfg.interventions.folder, cfg.episode_seed) if cfg.is_online else 0
    if not cfg.is_online and corrections.n_episodes == 0:
        raise InputError(
            f"The intervention dataset '{cfg.interventions.repo_id}' is empty: collect attempts with --num_episodes, or give "
            "one that holds some."
        )
    windows = PolicyWindows(cfg.policy, demos.meta, cfg.rename_map)
    demonstrations = read_store(demos, windows, training)
    corrections.read(windows.keys, demonstrations.device, demonstrations.image_size)
    learner.warn_of_reach(demonstrations.column(ACTION), "the demonstrations")
    if corrections.store is not None:
        learner.warn_of_reach(corrections.store.column(ACTION)[frames_by_expert(corrections.store)], "the corrections")
    batches = method.batches(cfg, windows, demonstrations, corrections.store)

    folder.begin(cfg, state)
    report = stack.enter_context(Report(cfg, training, folder, state))
    return Loop(cfg, training, folder, state, learner, windows, demonstrations, corrections, batches, report, scene)


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


def _print_results(cfg: DaggerConfig, folder: RunFolder, state: RunState, loop: Loop) -> None:
    print(f"\nFigures:     {folder.path / METRICS_NAME}")
    if cfg.is_online:
        print(
            f"Attempts:    {state.attempts}: {state.kept} kept in {cfg.interventions.folder}, {state.failed} failed, "
            f"{state.unneeded} needed no help, {state.discarded} thrown away"
        )
        totals = loop.report.totals
        print(
            f"Expert:      {totals['expert_steps']} steps in {totals['takeovers']} takeovers, {totals['switches']} context "
            f"switches, autonomy {totals['autonomy']:.0%}, {totals['person_seconds'] / 60:.1f} minutes of a person's time"
        )
    _print_what_is_learned(cfg, loop)
    if state.success is not None:
        is_older = state.evaluated_round != state.round
        when = f", after {state.evaluated_round} of {state.round} rounds" if is_older else ""
        print(f"Success:     {state.success:.1f} % of {state.evaluated_episodes or cfg.eval.n_episodes} episodes{when}")
    if loop.report.acted_early is not None:
        print(f"Early:       {loop.report.acted_early:.1f} % of them acted before anything was heard")
    is_better = state.success is not None and state.best and state.best["success"] > state.success
    if is_better and state.best["seeds"] == [cfg.seed, cfg.eval.n_episodes]:
        best = folder.checkpoints / BEST_LINK / PRETRAINED_MODEL_DIR if state.best["checkpoint"] else state.policy_path
        print(f"Best:        {state.best['success']:.1f} % of them: {printable(best)}")
        print("             The best of several evaluations looks better than it is: evaluate it on other seeds, too.")
    more = f"--num_episodes={2 * cfg.num_episodes}" if cfg.is_online else f"--steps={2 * cfg.steps}"
    go_on = f"Go on:       playbyear-dagger --resume=true --output_dir={shlex.quote(str(folder.path))} {more}"
    if state.checkpoint is None:
        print(f"No update was made: {_why_none(cfg, state)}.\n{go_on}")
        return
    policy = folder.checkpoints / "last" / PRETRAINED_MODEL_DIR
    print(f"Policy:      {policy}")
    print(f"Evaluate:    {evaluation_command(policy, cfg.env)}")
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
    print(f"Corrections: {text}")


def _why_none(cfg: DaggerConfig, state: RunState) -> str:
    if state.kept == 0:
        return "no attempt was kept"
    if cfg.updates_per_episode == 0:
        return "--updates_per_episode=0. To learn from all give --num_episodes=0 --steps=N and another --output_dir"
    return f"--warmup_episodes={cfg.warmup_episodes} is more than the dataset holds"


# Whether policy, demonstrations, corrections and environment go together


def _check_places(cfg: DaggerConfig) -> None:
    """Refuse what would be found out only once data were mixed.

    Raises:
        InputError: Attempts would be written among the demonstrations.
    """
    demos, interventions = (source.folder.resolve() for source in (cfg.dataset, cfg.interventions))
    if cfg.is_online and demos == interventions:
        raise InputError(
            f"--dataset and --interventions are the same dataset, {demos}: attempts would be written among the demonstrations, "
            "with what the policy did wrong in them. Give --interventions.repo_id and --interventions.root of their own."
        )
    is_within = cfg.output_dir.resolve().is_relative_to(interventions)
    if cfg.is_online and is_within and not (interventions / "meta").exists():
        raise InputError(
            f"--output_dir={cfg.output_dir} lies in the folder of --interventions, {interventions}, where a dataset is to be "
            "made: give another one."
        )


def _check_policy(policy: PreTrainedConfig) -> None:
    """Refuse what only `playbyear` learns from corrections.

    Raises:
        InputError: It is another policy, or several processes were started.
    """
    if not isinstance(policy, PlaybyearConfig):
        raise InputError(
            f"--policy.path is of the type '{policy.type}': playbyear-dagger corrects policies of --policy.type=playbyear. "
            "For others collect with LeRobot's lerobot-rollout --strategy.type=dagger, and learn with lerobot-train."
        )
    n_processes = int(os.environ.get("WORLD_SIZE", "1"))
    if n_processes > 1:
        raise InputError(
            f"{n_processes} processes were started, and playbyear-dagger works in one: start it without accelerate launch."
        )


def _check_dataset(policy: PlaybyearConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str]) -> None:
    """Refuse a dataset that the policy was not made for.

    Raises:
        ValueError: Frames per second, a missing feature, a shape, or a sample rate; what was seen and what is wanted.
    """
    check_dataset_suits(policy, meta, rename_map)
    names = dataset_names(policy, rename_map)
    for key, feature in {**(policy.input_features or {}), **(policy.output_features or {})}.items():
        name = names.get(key, key)
        seen_rate = (meta.features[name].get("info") or {}).get("sample_rate")
        rate = policy.sample_rate
        if rate is not None and seen_rate is not None and seen_rate != rate:
            raise InputError(
                f"'{name}' was recorded at {seen_rate} Hz in the dataset '{meta.repo_id}', and the policy was trained with "
                f"{rate} Hz: use data recorded at {rate} Hz, or train a policy for {seen_rate} Hz first."
            )
        seen, wanted = tuple(meta.features[name]["shape"]), tuple(feature.shape)
        same = sorted(seen) == sorted(wanted) if feature.type is FeatureType.VISUAL else seen == wanted
        if not same:
            raise InputError(
                f"'{name}' has shape {seen} in the dataset '{meta.repo_id}', and the policy was trained with {wanted}: use "
                "the data that it was trained with, or data recorded alike."
            )


def _check_alike(keys: Iterable[str], demos: LeRobotDatasetMetadata, own: Features, fps: float, what: str) -> None:
    """Refuse what cannot share a batch with the demonstrations.

    Args:
        keys: The observations that matter; the action always does.
        demos: The demonstrations' metadata.
        own: Features of a dataset, or of what the environment would write.
        fps: Their frames per second.
        what: What `own` is, for the message.

    Raises:
        InputError: With every difference.
    """
    found = [f"fps is {demos.fps} there and {fps} here"] if demos.fps != fps else []
    found += differences(demos.features, own, [*keys, ACTION], pictures_as_stored=False)
    if found:
        raise InputError(
            f"The demonstrations '{demos.repo_id}' and {what} differ: {'; '.join(found)}. Record with the same "
            "settings, or choose the environment's options (--env.*) as they were in the demonstrations."
        )


def _check_action_range(policy: PreTrainedConfig, trained: PreTrainedConfig, demonstrations: DatasetPlace) -> None:
    """Refuse a policy whose actions would all become larger, or smaller, before it has learned anything.

    Args:
        policy: The policy to improve.
        trained: As its checkpoint says.
        demonstrations: Of it.

    Raises:
        InputError: Their action ranges differ.
    """
    wanted, seen = (getattr(config, "action_range", None) for config in (policy, trained))
    if wanted != seen:
        raise InputError(
            f"--policy.action_range={wanted}: the policy was trained with {seen}, and would act differently from now on. "
            f"Train it on its demonstrations first: playbyear-train --preset=cpu --policy.path={policy.pretrained_path} "
            f"--policy.action_range={wanted} --dataset.repo_id={demonstrations.repo_id} "
            f"--dataset.root={demonstrations.folder} --output_dir=outputs/train/wider"
        )


def _check_expert(cfg: DaggerConfig, expert: Expert) -> None:
    """Refuse an expert that cannot do what the method asks of it.

    Raises:
        ExpertError: It never takes over by itself.
    """
    if cfg.method.needs_judge and not expert.judges:
        task = getattr(cfg.env, "task", None)
        raise ExpertError(
            f"--env.task={task} has a script that demonstrates, and none that says when a policy has to be corrected "
            f"(`intervention_gate()`): --method.type={cfg.method.type} needs one. Give --method.type=redo, which demonstrates "
            "the scenes that the policy fails in, or an expert of your own with --expert.type (examples/own_expert.py)."
        )
