"""HG-DAgger's rounds: attempt until one attempt is worth keeping, learn from it, save, and now and then evaluate."""

import contextlib
import io
import logging
import math
import time
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.utils.random_utils import set_seed

from lerobot_playbyear.compat import get_step_identifier
from lerobot_playbyear.dagger.batches import BalancedBatches
from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.corrections import Corrections
from lerobot_playbyear.dagger.report import Report, attempt_figures, round_figures
from lerobot_playbyear.dagger.run_folder import RunFolder, RunState
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.experts import Expert
from lerobot_playbyear.episodes.play import Episode, Seconds, play
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.training.batches import PolicyWindows
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import Learner
from lerobot_playbyear.training.report import Figures, is_due
from lerobot_playbyear.training.store import EpisodeStore

_ATTEMPT, _UPDATES, _EVALUATION = 0, 1, 2  # what random numbers are for
_LOSS_BATCHES = 10**9  # numbers from here on are of batches that are only looked at


@dataclass
class Scene:
    """Where attempts happen: the environment, the policy in it, and who corrects it, as the method has it."""

    env: gym.Env
    actor: PolicyActor
    expert: Expert


@dataclass
class Loop:
    """The rounds of a run.

    Random numbers are seeded for every attempt and for the updates of every round, so that a run that was killed and
    resumed ends with the weights of one that was not.

    Args:
        cfg, training: The options, and those of playbyear-train that follow from them.
        folder, state: Where the run is kept, and how far it is.
        learner: What learns.
        windows: Cut its batches.
        demonstrations, corrections: What is learned from.
        batches: Draws from both.
        report: Tells how it goes.
        scene: Where attempts happen; None to learn from recorded corrections alone.
    """

    cfg: DaggerConfig
    training: PlaybyearTrainConfig
    folder: RunFolder
    state: RunState
    learner: Learner
    windows: PolicyWindows
    demonstrations: EpisodeStore
    corrections: Corrections
    batches: BalancedBatches
    report: Report
    scene: Scene | None

    def run(self) -> None:
        """Go on until the run is complete, or until the policy needs the expert no more.

        Raises:
            PlaybyearError: No attempt succeeds even with the expert, the training diverges, or something cannot be written.
        """
        if self.scene is not None:
            self.cfg.method.begin(self)
            self._note_unnoted_attempt()
        self._evaluate_if_due()
        while not self._is_complete():
            start, seconds = time.perf_counter(), Seconds()
            if self.scene is not None and self.state.kept == self.state.round and not self._collect(seconds):
                break
            losses = self._update(seconds)
            self._finish_round(start, seconds, losses)
            self._evaluate_if_due()
        self._evaluate_if_due(is_last=True)

    def _is_complete(self) -> bool:
        if self.scene is None:
            return self.state.step >= self.cfg.steps
        return self.state.kept >= self.cfg.num_episodes and self.state.kept == self.state.round

    # Attempts

    def _note_unnoted_attempt(self) -> None:
        """Counts an attempt that was written to disk just before the run was killed."""
        state = self.state
        n_noted = (state.first_episodes or 0) + state.kept
        n_unnoted = self.corrections.n_episodes - n_noted
        if n_unnoted == 0:
            return
        if n_unnoted != 1 or state.kept != state.round:
            raise InputError(
                f"The intervention dataset holds {self.corrections.n_episodes} attempts, and this run knows of {n_noted}: "
                "something else changed it. Begin a new run in another --output_dir; it may append to the same dataset."
            )
        figures, by_expert = self.corrections.last()
        self.cfg.method.note_recovered()
        figures |= {"outcome": "kept", **self._cost(by_expert), "recovered": True}
        state.fruitless.clear()
        self._count(figures)
        self.report.bar.update(1)

    def _collect(self, seconds: Seconds) -> bool:
        """Attempts until one is kept. Returns False when there is none among `max_attempts` in which the expert might act."""
        fruitless = self.state.fruitless
        while len(fruitless) < self.cfg.max_attempts or self.state.to_show is not None:
            self.report.doing("acting")
            spent, is_alone = Seconds(), self.cfg.method.is_alone
            episode = self._attempt(spent)
            outcome = self.cfg.method.outcome(episode)
            if outcome == "kept":
                fruitless.clear()
                with spent.of("episode_saving"):
                    self.corrections.append(episode)
                assert self.corrections.store is not None
                self.batches.take_in(self.corrections.store)
            elif not is_alone or outcome == "discarded":
                fruitless.append(outcome)
            self._note(episode, outcome, spent)
            seconds.add(spent)
            if outcome == "kept":
                self.report.bar.update(1)
                by_expert = torch.from_numpy(episode.actions[episode.interventions])
                self.learner.warn_of_reach(by_expert, f"the corrections of attempt {self.state.attempts}")
                return True
        self._tell_why_none(list(fruitless))
        return False

    def _tell_why_none(self, outcomes: list[str]) -> None:
        """Says why no attempt was kept.

        Raises:
            InputError: Most failed although the expert might help.
        """
        self.state.fruitless.clear()  # who goes on with the run wants others
        self.folder.commit(self.state)
        n, n_failed, n_unneeded = len(outcomes), outcomes.count("failed"), outcomes.count("unneeded")
        if n_failed > n / 2:
            raise InputError(
                f"{n_failed} of {n} attempts in a row failed in spite of the expert: it cannot rescue this policy. Begin with "
                "a better one, or look at the environment's options."
            )
        if n_unneeded == n:
            logging.info(f"The policy needed no help in {n} attempts in a row: there is nothing left to correct.")
            return
        logging.info(
            f"None of {n} attempts in a row could be kept: {n_unneeded} needed no help, {n_failed} failed, and "
            f"{outcomes.count('discarded')} were thrown away."
        )

    def _attempt(self, spent: Seconds) -> Episode:
        """The next attempt: in a new scene or, where the last one failed and the method wants it shown, in that one."""
        assert self.scene is not None
        state = self.state
        while state.next_seed in self.cfg.eval_seeds:
            state.next_seed += 1
        self.cfg.method.prepare(demonstrates=state.to_show is not None)
        seed = state.next_seed if state.to_show is None else state.to_show
        set_seed(self._random_seed(_ATTEMPT, seed))
        return play(self.scene.env, self.scene.actor, seed, expert=self.scene.expert, seconds=spent)

    def _note(self, episode: Episode, outcome: str, spent: Seconds) -> None:
        assert episode.interventions is not None
        self.cfg.method.note(episode, outcome)
        figures = {"seed": episode.seed, "n_frames": len(episode), "success": episode.success, "outcome": outcome}
        self._count(figures | self._cost(episode.interventions) | _rounded(spent))

    def _count(self, figures: dict[str, Any]) -> None:
        """Makes an attempt count."""
        state, outcome = self.state, figures["outcome"]
        state.attempts += 1
        setattr(state, outcome, getattr(state, outcome) + 1)
        is_by_person = self.scene is not None and self.scene.expert.decides
        is_repeated = outcome == "discarded" and is_by_person
        state.next_seed = figures["seed"] + (not is_repeated)
        is_to_show = outcome == "failed" and self.cfg.method.shows_failures and state.to_show is None
        state.to_show = figures["seed"] if is_to_show else None
        self.report.write("attempt", figures)
        self.folder.commit(state)

    def _cost(self, by_expert: np.ndarray) -> dict[str, Any]:
        """What an attempt cost, from the column `intervention`, (T,) bool."""
        assert self.scene is not None
        fps = self.scene.expert.clock_fps or self.demonstrations.fps
        cost = attempt_figures(by_expert, fps, self.cfg.method.is_watched)
        return cost if self.state.to_show is None else {**cost, "n_switches": 1}  # from the policy, which had failed

    # Learning

    def _n_updates(self) -> int:
        if self.scene is None:
            return min(max(self.cfg.updates_per_episode, 1), self.cfg.steps - self.state.step)
        is_warm = (self.state.first_episodes or 0) + self.state.kept >= self.cfg.warmup_episodes
        return self.cfg.updates_per_episode if is_warm else 0

    def _update(self, seconds: Seconds) -> dict[str, Any]:
        """The round's updates. Returns losses and the like, none without updates.

        Raises:
            InputError: The training diverged: nobody could act with these weights, or go on from them.
        """
        n_updates = self._n_updates()
        if n_updates == 0:
            return {}
        learner = self.learner
        assert self.training.optimizer is not None
        grad_clip_norm = self.training.optimizer.grad_clip_norm
        set_seed(self._random_seed(_UPDATES, self.state.round))
        tracker = Figures(self.cfg.batch_size, self.demonstrations, learner.step, learner.accelerator)
        for number in range(n_updates):
            self.report.doing(f"learning {number + 1}/{n_updates}")
            rate = self.cfg.rate(learner.step, number, n_updates, self.state.first_episodes or 0)
            with seconds.of("batch"):
                batch = self.batches.batch(learner.step)
            for group in learner.optimizer.param_groups:
                group["lr"] = rate
            with seconds.of("update"):
                tracker.add(learner.update(batch, grad_clip_norm))
            if self.scene is None:
                self.report.bar.update(1)
        averages, _ = tracker.read()
        figures = {key: averages[key] for key in ("loss", "grad_norm")}
        with seconds.of("loss"):
            halves = self.batches.halves(_LOSS_BATCHES + self.state.round)
            figures["loss_demonstrations"], figures["loss_interventions"] = (learner.loss(half) for half in halves)
        skipped = {"grad_norm"} if learner.accelerator.scaler else set()  # float16 leaves such an update out
        endless = [name for name in figures if name not in skipped and not math.isfinite(figures[name])]
        if endless:
            raise InputError(
                f"The training diverged in round {self.state.round + 1}: {endless[0]} is {figures[endless[0]]}. Nothing of it "
                f"is saved; the last good weights are {self.folder.checkpoint(self.state) or self.state.policy_path}. Go on "
                f"from them with --resume=true --learning_rate={self.cfg.largest_rate / 10:g}."
            )
        return {"n_updates": n_updates, **figures}

    def _finish_round(self, start: float, seconds: Seconds, losses: dict[str, Any]) -> None:
        """Saves the weights and makes the round count."""
        state = self.state
        state.round += 1
        if losses:
            self.report.doing("saving")
            name = get_step_identifier(self.learner.step, self.training.steps)
            with seconds.of("checkpoint_saving"):
                self.folder.save_checkpoint(name, lambda path: self.learner.write_checkpoint(path, self.training))
            state.checkpoint, state.step = name, self.learner.step
            state.made = [*dict.fromkeys([*state.made, name])]
        total = time.perf_counter() - start
        spent = {} if self.scene is None else round_figures(self.folder.metrics(), state.round)
        self.report.write("round", {**losses, **spent, **_rounded(seconds), "total_s": round(total, 4)})
        self.folder.commit(state)
        self.folder.clean(state)

    def _evaluate_if_due(self, is_last: bool = False) -> None:
        cfg, state = self.cfg, self.state
        wanted = cfg.eval_every > 0 and (is_last or is_due(state.round, cfg.eval_every))
        is_other = is_last and state.evaluated_episodes not in (None, cfg.eval.n_episodes)
        is_same = state.evaluated_round == state.round or state.evaluated_step == state.step
        if cfg.env is None or not wanted or (is_same and not is_other):
            return
        self.report.doing("evaluating")
        start = time.perf_counter()
        set_seed(self._random_seed(_EVALUATION, state.round))  # of policies that act by chance
        with contextlib.redirect_stderr(io.StringIO()):  # LeRobot's own progress bars; ours goes on
            info = self.learner.evaluate(self.training, 0)
        state.evaluated_round, state.evaluated_step = state.round, state.step
        state.evaluated_episodes = cfg.eval.n_episodes
        state.success = float(info["overall"]["pc_success"])
        seeds, is_trained = [cfg.seed, cfg.eval.n_episodes], state.checkpoint is not None or not cfg.new_weights
        is_best = state.best.get("seeds") != seeds or state.success >= state.best["success"]  # of equal ones the last
        for name in (state.best.get("checkpoint"), state.checkpoint):
            if name is not None and name not in state.milestones:
                state.milestones.append(name)
        if is_trained and is_best:
            state.best = {"success": state.success, "checkpoint": state.checkpoint, "seeds": seeds}
        self.report.write_evaluation(info, evaluation_s=round(time.perf_counter() - start, 3))
        self.folder.commit(state)
        self.folder.clean(state)

    def _random_seed(self, purpose: int, number: int) -> int:
        return int(np.random.SeedSequence([self.cfg.seed, purpose, number]).generate_state(1)[0])


def _rounded(seconds: Seconds) -> dict[str, float]:
    return {f"{name}_s": round(value, 4) for name, value in seconds.spent.items()}
