"""A script with a person's imperfections: late, unsteady, wrong now and then, and the same again for the same seed."""

from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_playbyear.episodes.experts import ScriptedExpertConfig, ScriptedPerson

FPS = 20


class Gate:
    """Wants control in chosen steps, or while it is told to have it; remembers what it is told."""

    def __init__(self, steps):
        self.steps, self.n, self.told, self.is_told = set(steps), -1, [], False

    def wants_control(self, policy_action):
        self.n += 1
        return self.n in self.steps or self.is_told

    def act(self):
        return np.array([0.5, 0.0, 0.0, 1.0])

    def take_over(self, until_told=True):
        self.is_told = until_told
        self.told.append((self.n, until_told))

    def hand_back(self):
        self.is_told = False
        self.told.append((self.n, None))


def person(steps=(), seed=3, **options):
    gate = Gate(steps)
    expert = ScriptedPerson(ScriptedExpertConfig(person=True, **{"wrong_per_minute": 0.0, **options}), FPS)
    env = SimpleNamespace(unwrapped=SimpleNamespace(intervention_gate=lambda: gate, np_random_seed=seed))
    expert.reset(env)
    return expert, gate


def control(expert, n=200, calls=None):
    """In which of n steps it acts, and what it does then."""
    steps, actions = [], []
    for n_step in range(n):
        if calls is not None:
            expert.call(n_step in calls)
        if expert.wants_control({}, np.zeros(4)):
            steps.append(n_step)
            actions.append(expert.act())
    return steps, np.array(actions)


def test_a_person_sees_a_mistake_and_its_end_later():
    expert, gate = person(range(20, 40), reaction_s=0.3)
    steps, _ = control(expert)
    assert steps == list(range(26, 46))
    assert gate.told == [(26, False), (46, None)]  # it begins from where the hand is then


def test_a_person_who_is_called_comes_later_and_does_not_look_for_mistakes():
    expert, gate = person(range(50, 60))
    assert control(expert, calls=range(100, 120))[0] == list(range(106, 126))
    assert gate.told == [(106, True), (126, None)]


def test_the_hand_trembles_slowly_and_the_gripper_does_not():
    _, actions = control(person(range(2000), tremor=0.1, tremor_s=0.2)[0], 2000)
    error = actions[:, :3] - [0.5, 0, 0]
    assert error.std() == pytest.approx(0.1, rel=0.15)
    assert abs(error.mean()) < 0.02
    assert (actions[:, 3] == 1).all()
    after = [np.corrcoef(error[:-lag, 0], error[lag:, 0])[0, 1] for lag in (1, 4, 40)]
    assert after[0] > 0.7 > after[1] > 0.2 > abs(after[2])


def test_a_person_takes_over_without_need_now_and_then_and_gives_back():
    taken, n = [], 1200  # a minute
    for seed in range(20):
        steps, _ = control(person(seed=seed, wrong_per_minute=3.0, wrong_s=0.5, reaction_s=0.0)[0], n)
        begins = [step for step in steps if step - 1 not in steps]
        assert len(steps) <= 10 * len(begins)
        taken.append(len(begins))
    assert 2 < np.mean(taken) < 4


def test_the_same_seed_meets_the_same_person_and_another_one_another():
    options = {"steps": range(20, 40), "wrong_per_minute": 10.0}
    first, again, other = (control(person(seed=seed, **options)[0]) for seed in (3, 3, 4))
    assert first[0] == again[0]
    np.testing.assert_array_equal(first[1], again[1])
    assert first[0] != other[0]
