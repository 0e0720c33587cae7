"""A few updates of a small policy `playbyear` with its usual options, in one number: `python tests/training_digest.py`.

Run it to get the digest of the machine that it runs on, for `TRAINED` in `test_auxiliary.py`.
"""

import hashlib
from pathlib import Path

import torch
from support.policy import make_config, make_episode, run_ending_at

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy


def probe() -> str:
    """This processor, and what this torch makes of a convolution, an LSTM and a transform on it, without any code of ours."""
    torch.manual_seed(0)
    layers = [torch.nn.Conv2d(3, 4, 3), torch.nn.LSTM(8, 8, batch_first=True), torch.nn.Linear(8, 8)]
    loss = layers[0](torch.rand(2, 3, 16, 16)).square().mean() + layers[2](layers[1](torch.rand(2, 9, 8))[0]).sum()
    loss = loss + torch.stft(torch.rand(2, 999), 640, window=torch.hann_window(640), return_complex=True).abs().mean()
    loss.backward()
    return _digest(
        f"{torch.__version__} {_processor()}".encode(), [p.grad for layer in layers for p in layer.parameters()]
    )


def _processor() -> str:
    """Which it is: libraries choose their kernels by maker, model and instructions."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text().split("\n\n")[0].splitlines() if facts.exists() else []
    return "\n".join(line for line in lines if line.startswith(("vendor_id", "cpu family", "model", "flags")))


def trained(n_updates: int = 3, **options) -> str:
    """Names and bits of all weights after some updates."""
    torch.manual_seed(1)
    policy = PlaybyearPolicy(make_config(audio_noise_db=18.0, low_dimensional_noise=0.03, **options)).train()
    optimizer = torch.optim.Adam(policy.get_optim_params(), lr=1e-3)
    for update in range(n_updates):
        policy.forward(run_ending_at(make_episode(update, policy.config), 5 + 20 * update, policy.config))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    state = policy.state_dict()
    return _digest("\n".join(state).encode(), list(state.values()))


def _digest(start: bytes, tensors: list) -> str:
    digest = hashlib.sha256(start)
    for tensor in tensors:
        digest.update(tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(probe(), trained())
