"""The scripted expert beside a policy: when it takes over, what it rescues, when it hands back."""

import gymnasium as gym
import numpy as np
import pytest

from gym_playbyear import TASKS
from gym_playbyear.experts import occluded_gate
from gym_playbyear.experts.occluded_gate import EMPTY_OPENING, GRASP_HEIGHT, MISSED_HEIGHT, InterventionGate

STAY = np.array([0.0, 0.0, 0.0, -1.0])


def make(task: str, **options):
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", sound="none", **options)


class Still:
    """A policy that does nothing."""

    def act(self):
        return STAY


class Restless:
    """A policy whose actions are noise."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)

    def act(self):
        return np.append(self.rng.uniform(-0.5, 0.5, 3), self.rng.choice([-1.0, 1.0]))


def make_policy(task_env, name: str, seed: int):
    match name:
        case "expert":
            return task_env.scripted_expert()
        case "still":
            return Still()
        case "restless":
            return Restless(seed)
    return task_env.blind_baselines()[name]


def roll_out(env, seed: int, name: str):
    """One episode: whether it was solved, who acted in each step (T,), and the gate's reasons in their order."""
    env.reset(seed=seed)
    task_env = env.unwrapped
    policy, gate = make_policy(task_env, name, seed), task_env.intervention_gate()
    by_expert, reasons, done = [], [], False
    while not done:
        before, action = gate.reason, policy.act()
        by_expert.append(gate.wants_control(action))
        if gate.reason is not None and gate.reason != before:
            reasons.append(gate.reason)
        _, terminated, truncated, info = task_env.step_physics(gate.act() if by_expert[-1] else action)
        done = terminated or truncated
    return info["is_success"], np.array(by_expert), reasons


@pytest.mark.parametrize(
    "task",
    [task for task in TASKS if task.startswith("Occluded")],
)
def test_a_policy_as_good_as_the_expert_is_left_alone(task):
    env = make(task)
    episodes = [roll_out(env, seed, "expert") for seed in range(3000, 3014)]
    env.close()
    assert all(success for success, _, _ in episodes)
    assert np.mean([by_expert.any() for _, by_expert, _ in episodes]) <= 0.2
    assert np.mean(np.concatenate([by_expert for _, by_expert, _ in episodes])) <= 0.05


RESCUED = {
    "OccludedGrasp-v1": {"search": 4, "push": 5},
    "OccludedPickPlace-v1": {"middle": 4},
}  # of six episodes, at least


@pytest.mark.parametrize(
    ("task", "name"),
    [(task, name) for task, names in RESCUED.items() for name in names],
)
def test_a_bad_policy_is_rescued(task, name):
    """Alone these policies solve at most every fifth episode (`test_tasks.py` has the blind ones). The expert needs time."""
    env = make(task, horizon=350)
    episodes = [roll_out(env, seed, name) for seed in range(3000, 3006)]
    env.close()
    assert sum(success for success, _, _ in episodes) >= RESCUED[task][name]
    assert sum(by_expert.any() for _, by_expert, _ in episodes) >= 5


def test_the_expert_hands_back_when_it_has_found_the_cube_and_when_it_holds_it():
    """A policy that stands still gets the control back after the search, and again once the fingers hold."""
    env = make("OccludedGrasp-v1", horizon=300)
    task_env = env.unwrapped
    env.reset(seed=0)
    gate, stages, done = task_env.intervention_gate(), [], False
    while not done:
        before = gate.reason
        by_expert = gate.wants_control(STAY)
        if before is not None and gate.reason != before:
            stages.append(gate.expert.phase)
        _, terminated, truncated, _ = task_env.step_physics(gate.act() if by_expert else STAY)
        done = terminated or truncated
    env.close()
    assert stages[0] in ("dwell", "rise")
    assert stages[1] == "lift"


def until(env, gate, expert, phase: str) -> None:
    """Lets an expert act as the policy, until it is in `phase`; the gate looks on."""
    while expert.phase != phase:
        action = expert.act()
        gate.wants_control(action)
        env.unwrapped.step_physics(action)


@pytest.fixture
def patient(monkeypatch):
    """The gate does not mind a hand that stands still."""
    monkeypatch.setattr(occluded_gate, "STILL_STEPS", 100)


def at_phase(task: str, phase: str, seed: int = 1, **options):
    env = make(task, **options)
    env.reset(seed=seed)
    expert = env.unwrapped.scripted_expert()
    gate = InterventionGate(env.unwrapped, env.unwrapped.scripted_expert())
    until(env, gate, expert, phase)
    assert gate.reason is None
    return env, gate


@pytest.mark.parametrize(("task", "phase"), [("OccludedGrasp-v1", "lift"), ("OccludedPickPlace-v1", "carry")])
def test_before_it_lets_go_of_the_cube_the_expert_goes_on_where_the_policy_is(task, phase, patient):
    env, gate = at_phase(task, phase, horizon=350)
    hold, let_go = np.array([0, 0, 0, 1.0]), np.array([0, 0, 0, -1.0])
    assert not env.unwrapped.gripper_obeys
    assert not gate.wants_control(let_go)  # nothing happens yet: the fingers have just closed
    while not env.unwrapped.gripper_obeys:
        env.unwrapped.step_physics(hold)
        assert not gate.wants_control(hold)
    assert gate.wants_control(let_go)
    assert (gate.reason, gate.expert.phase) == ("opens", phase)
    env.close()


def carried(drift, n_steps=60, **options):
    """Pick and Place, version 1: a policy that carries the cube, moves by `drift` on the way, and the gate that watches."""
    env, gate = at_phase("OccludedPickPlace-v1", "carry", **options)
    play(env, gate, np.array([*drift, 1.0]), n_steps)
    return env, gate


@pytest.mark.parametrize("drift", [(0, -0.3, 0), (0, -0.3, -0.025)])
def test_a_cube_that_would_be_put_down_beside_the_tray_is_carried_back_and_then_to_the_tray(drift):
    env, gate = carried(drift)
    tray = env.unwrapped.position("bin")
    assert (gate.reason, gate.expert.phase) == ("misplaces", "bring_back")
    ways, done, info = [], False, {}
    while not done:
        ways.append(env.unwrapped.position("cube")[1] - tray[1])
        _, terminated, truncated, info = env.unwrapped.step_physics(gate.act())
        done = terminated or truncated
        assert gate.wants_control(STAY) or done
    assert info["is_success"]
    assert max(ways) == pytest.approx(gate._lifted_at[1] - tray[1], abs=0.03)  # back to where it was lifted
    assert min(ways[int(np.argmax(ways)) :]) > -0.02  # and not past the tray again
    env.close()


def test_a_label_where_the_cube_would_be_put_down_leads_to_the_tray(patient):
    env, gate = at_phase("OccludedPickPlace-v1", "carry")
    forward, lets_go = np.array([0, -0.3, 0, 1.0]), np.array([0, -0.3, 0, -1.0])
    for _ in range(40):
        gate.wants_control(lets_go if env.unwrapped.gripper_obeys else forward)
        left = env.unwrapped.position("cube")[1] - env.unwrapped.position("bin")[1]
        label = gate.label()
        assert label[1] * left < 0.2 * abs(left)  # never back, even in the first step of a mistake
        env.unwrapped.step_physics(forward)
    env.close()


def play(env, gate, action, n_steps: int) -> int:
    """The policy does the same at every step until the expert takes over; returns how often it did."""
    for step in range(n_steps):
        if gate.wants_control(action):
            return step
        env.unwrapped.step_physics(action)
    raise AssertionError(f"nobody took over in {n_steps} steps")


def finish(env, gate) -> bool:
    """The expert acts as long as it wants to, and a policy that lifts what it holds after it; whether the task was solved."""
    done, info = False, {}
    while not done:
        task_env = env.unwrapped
        up = np.array([0, 0, 0.3 if task_env.eef_position[2] < 0.88 else 0.0, 1.0])
        up = up if task_env.contact_forces["gripper-cube"] > 20 else STAY
        _, terminated, truncated, info = env.unwrapped.step_physics(gate.act() if gate.wants_control(up) else up)
        done = terminated or truncated
    return info["is_success"]


def test_a_hand_that_is_about_to_land_on_the_cube_searches_anew():
    env, gate = at_phase("OccludedGrasp-v1", "descend", horizon=350)
    task_env = env.unwrapped
    while task_env.eef_position[1] < task_env.position("cube")[1] + 0.02:  # a hop that is 2 cm too long
        task_env.step_physics(np.array([0, 0.15, 0.1, -1.0]))
        assert not gate.wants_control(STAY)
    play(env, gate, np.array([0, 0, -0.2, -1.0]), 30)
    assert (gate.reason, gate.expert.phase) == ("lands", "retreat")
    assert task_env.eef_position[2] > 0.8 + GRASP_HEIGHT
    assert finish(env, gate)
    env.close()


def test_fingers_that_closed_on_nothing_bring_the_expert():
    env, gate = at_phase("OccludedGrasp-v1", "sweep", horizon=350)
    taken_after = play(env, gate, np.array([0, 0, 0, 1.0]), 20)
    assert gate.reason == "empty"
    assert taken_after > 3
    assert env.unwrapped.finger_positions.sum() < EMPTY_OPENING
    env.close()


def test_a_hand_that_pushes_on_after_the_touch_is_stopped_in_time():
    env, gate = at_phase("OccludedGrasp-v1", "dwell")
    push = np.array([0.0, 0.2, 0.0, -1.0])
    taken_over, terminated = [], False
    for _ in range(20):
        taken_over.append(gate.wants_control(push))
        _, terminated, _, _ = env.unwrapped.step_physics(gate.act() if taken_over[-1] else push)
        if taken_over[-1]:
            break
    assert gate.reason == "pushes"
    assert not taken_over[0]
    assert not terminated
    env.close()


def test_a_dropped_cube_brings_the_expert(patient):
    env, gate = at_phase("OccludedPickPlace-v1", "carry")
    close, open_ = np.array([0, 0, 0, 1.0]), np.array([0, 0, 0, -1.0])
    for _ in range(60):  # the gate hears of a policy that holds on, and the hand lets go
        if gate.wants_control(close):
            break
        env.unwrapped.step_physics(open_)
    assert gate.reason == "dropped"
    env.close()


def test_a_hand_that_rises_without_the_cube_brings_the_expert():
    env, gate = at_phase("OccludedGrasp-v1", "hop")
    up = np.array([0, 0, 0.4, -1.0])
    for _ in range(10):
        if gate.wants_control(up):
            break
        env.unwrapped.step_physics(up)
    assert gate.reason == "missed"
    assert env.unwrapped.eef_position[2] > 0.8 + MISSED_HEIGHT
    env.close()


def test_the_same_seed_gives_the_same_interventions():
    env = make("OccludedPickPlace-v1")
    first, again = (roll_out(env, 5, "middle") for _ in range(2))
    env.close()
    np.testing.assert_array_equal(first[1], again[1])
    assert first[2] == again[2]


# Where somebody else decides


class Wanders:
    """The task's expert, but for its first steps, in which it goes anywhere with open fingers."""

    def __init__(self, task_env, seed, n_steps):
        self.rng, self.expert, self.n = np.random.default_rng(seed), task_env.scripted_expert(), 0
        self.n_steps = n_steps

    def act(self):
        self.n += 1
        wandering = np.append(self.rng.uniform(-0.5, 0.5, 3), -1.0)
        return wandering if self.n < self.n_steps else self.expert.act()


@pytest.mark.parametrize(("task", "n"), [("OccludedGrasp-v1", 30), ("OccludedPickPlace-v1", 30)])
def test_labels_solve_the_task_from_wherever_the_policy_went(task, n):
    """Of DAgger: the policy acts for a while, and then whoever follows the labels succeeds, though the expert never acted."""
    env, solved = make(task), 0
    for seed in range(4):
        env.reset(seed=seed)
        task_env = env.unwrapped
        gate, policy, done, step = task_env.intervention_gate(), Wanders(task_env, seed, n), False, 0
        while not done:
            action = policy.act()
            gate.wants_control(action)
            label = gate.label()
            assert gate.reason is None
            _, terminated, truncated, info = task_env.step_physics(action if step < n + 10 else label)
            done, step = terminated or truncated, step + 1
        solved += info["is_success"]
    env.close()
    assert solved >= 3


def test_an_expert_that_was_asked_stays_until_it_is_told():
    env = make("OccludedGrasp-v1")
    env.reset(seed=2)
    task_env = env.unwrapped
    gate, policy = task_env.intervention_gate(), task_env.scripted_expert()
    acts, done, n, info = [], False, 0, {}
    while not done:
        action = policy.act()
        acts.append(gate.wants_control(action))
        if n == 10:
            assert not acts[-1]  # nothing was wrong
            gate.take_over()
        _, terminated, truncated, info = task_env.step_physics(gate.act() if n >= 10 else action)
        done, n = terminated or truncated, n + 1
    env.close()
    assert all(acts[11:])
    assert info["is_success"]
    gate.hand_back()
    assert gate.reason is None
