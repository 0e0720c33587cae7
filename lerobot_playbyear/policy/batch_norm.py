"""Batch norm, and means, over the processes of one training: several of them learn what one with all their data would."""

import torch
from torch import Tensor, distributed, nn


def n_processes() -> int:
    """How many processes train together."""
    return distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1


def is_first_process() -> bool:
    """Whether this is the process that writes files, of those that train together."""
    return n_processes() == 1 or distributed.get_rank() == 0


def mean_over_processes(values: Tensor) -> Tensor:
    """The mean of every process's values, of the same shape; gradients flow back to all of them."""
    if n_processes() == 1:
        return values
    from torch.distributed.nn.functional import all_reduce  # not in every build of torch

    return all_reduce(values) / n_processes()


def share_batch_norm(network: nn.Module) -> None:
    """Makes every `nn.BatchNorm2d` in a network one of all processes, with the parameters and statistics that it has."""
    for norm in network.modules():
        if type(norm) is nn.BatchNorm2d:
            norm.__class__ = SharedBatchNorm2d


class SharedBatchNorm2d(nn.BatchNorm2d):
    """Batch norm whose statistics in training are those of all processes' batches; parameters and names are torch's.

    `nn.SyncBatchNorm` does this on GPUs alone, and keeps DistributedDataParallel from working on a CPU.
    """

    def forward(self, input: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H, W). Every process must have as many items."""
        if not self.training or n_processes() == 1:
            return super().forward(input)
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        values = input.float()
        mean = mean_over_processes(values.mean(dim=(0, 2, 3)))
        centred = values - mean[:, None, None]
        variance = mean_over_processes(centred.square().mean(dim=(0, 2, 3)))
        with torch.no_grad():
            n_values = n_processes() * input.numel() // input.shape[1]
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * n_values / (n_values - 1), self.momentum)
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(input.dtype)
