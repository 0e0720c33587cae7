"""The study of carries: who acts, and what it tells of a policy that moves alike, and of one that repeats its last movement."""

import numpy as np

from experiments.carries import EDGES_MM, Companion, table_of
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play


class Slow:
    """Wants a tenth of the largest step towards the tray, whatever is there."""

    def reset(self, env):
        self.script = env.unwrapped.scripted_expert()

    def act(self, observation):
        action = self.script.act()
        return np.array([0, -0.1, 0, 1], np.float32) if self.script.phase == "carry" else action


def carried(acts):
    env = env_spec(PlaybyearEnvConfig(task="OccludedPickPlace-v1")).make()
    companion = Companion(acts)
    episode = play(env, Slow(), 50_000, expert=companion)
    env.close()
    return np.array(companion.rows), episode


def test_the_expert_carries_and_the_policys_wish_stands_beside():
    rows, episode = carried(acts=True)
    assert episode.success
    assert episode.interventions.all()
    far = rows[rows[:, 0] > 100]
    assert len(far) > 5
    np.testing.assert_allclose(far[-5:, 2], 40, atol=10)  # 2 cm of 5 cm
    assert far[:, 2].mean() > 2 * far[:, 1].mean()


def test_a_policy_carries_as_it_wants():
    rows, episode = carried(acts=False)
    assert not episode.interventions.any()
    on_the_way = (rows[:, 0] > 60) & (np.arange(len(rows)) > 5)
    assert on_the_way.sum() > 20
    np.testing.assert_allclose(rows[on_the_way, 1], 10, atol=1e-4)


def test_the_table_tells_where_nobody_was():
    own, shown = np.array([[500.0, 20, 20]]), np.array([[500.0, 30, 40], [500.0, 50, 40], [0.0, 1, 2]])
    rows = table_of(own, shown).splitlines()
    assert len(rows) == len(EDGES_MM) + 1
    assert rows[2] == "| 300 to 800 mm | 40 ± 0 % (2) | 40 ± 10 % (2) | 20 ± 0 % (1) |"
    assert rows[-1] == "| -10 to 10 mm | 2 ± 0 % (1) | 1 ± 0 % (1) | never there |"
