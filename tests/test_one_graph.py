"""A training step is one graph: whatever compiles or replays it meets nothing that needs Python in between."""

import torch
from test_policy_contract import make_config, make_episode, run_ending_at

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy


def test_a_training_step_traces_as_one_graph_without_a_break():
    """With everything on that training can have: noise, augmentation, two senses, episodes that have not begun."""
    policy = PlaybyearPolicy(make_config(audio_noise_db=0.0, low_dimensional_noise=0.03, n_supervised_steps=3)).train()
    batch = run_ending_at(make_episode(1, policy.config), 5, policy.config)
    with torch._dynamo.config.patch(allow_rnn=True):  # torch by itself leaves every LSTM out
        explained = torch._dynamo.explain(lambda batch: policy.forward(batch)[0])(batch)
    assert explained.break_reasons == []
    assert (explained.graph_count, explained.graph_break_count) == (1, 0)
