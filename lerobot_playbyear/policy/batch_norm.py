"""Batch norm, and means, over the processes of one training: several of them learn what one with all their data would."""

from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional


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
    """Makes every `nn.BatchNorm2d` in a network one of all processes; the names in its `state_dict` stay."""
    for parent in list(network.modules()):
        for name, norm in parent.named_children():
            if type(norm) is nn.BatchNorm2d:
                shared = SharedBatchNorm2d(
                    norm.num_features, norm.eps, norm.momentum, norm.affine, norm.track_running_stats
                )
                shared.load_state_dict(norm.state_dict())
                parent.register_module(name, shared)


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
        output, mean, variance = _Normalised.apply(input, self.weight, self.bias, self.eps)
        with torch.no_grad():
            n_values = n_processes() * input.numel() // input.shape[1]
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * n_values / (n_values - 1), self.momentum)
        return output


class _Normalised(torch.autograd.Function):
    """Batch norm of all processes: torch's own passes over the values, and one exchange of statistics each way."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, input: Tensor, weight: Tensor, bias: Tensor, eps: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, variances = _gathered(torch.batch_norm_update_stats(input.float(), None, None, 0.0))  # each (W, C)
        mean = means.mean(dim=0)
        variance = (variances + (means - mean).square()).mean(dim=0)
        ctx.save_for_backward(input, weight, mean, variance)
        ctx.eps = eps  # type: ignore[attr-defined]
        ctx.mark_non_differentiable(mean, variance)
        return functional.batch_norm(input, mean, variance, weight, bias, eps=eps), mean, variance

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        input, weight, mean, variance = ctx.saved_tensors
        _, of_weight, of_bias = torch.ops.aten.native_batch_norm_backward(
            gradients[0], input, weight, mean, variance, None, None, False, ctx.eps, [False, True, True]
        )
        per_value = torch.stack([of_weight, of_bias])
        distributed.all_reduce(per_value)
        through_deviation, through_mean = per_value * (input.shape[1] / (n_processes() * input.numel()))
        slope = weight * torch.rsqrt(variance + ctx.eps)
        # What mean and variance owe to the values is a batch norm of them; what the values owe to themselves comes on top.
        of_input = functional.batch_norm(
            input, mean, variance, -slope * through_deviation, -slope * through_mean, eps=ctx.eps
        )
        of_input.addcmul_(gradients[0], slope[:, None, None].to(of_input.dtype))
        return of_input, of_weight, of_bias, None


def _gathered(values: tuple[Tensor, ...]) -> Tensor:
    """Tensors of one shape, of all processes: (len(values), processes, *shape)."""
    own = torch.stack(values)
    everyones = [torch.empty_like(own) for _ in range(n_processes())]
    distributed.all_gather(everyones, own)
    return torch.stack(everyones, dim=1)
