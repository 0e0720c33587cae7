"""What Apple's GPUs (MPS) can compute: the operators that the policy may use, in every torch from 2.7 on.

Made from torch's own table, `native_functions.yaml`, of 2.7.0 and of 2.11.0; `test_devices.py` holds the installed torch's
against it. A new operator goes here when both tables name a kernel for MPS.
"""

_KERNELS = """
    _fft_c2r _fft_r2c _local_scalar_dense _upsample_bilinear2d_aa add.Tensor add_.Tensor addcdiv_ addcmul_ addmm all
    amax amin any any.dim as_strided avg_pool2d bitwise_and.Tensor bitwise_not bmm cat ceil_ clamp clamp_ clamp_min
    constant_pad_nd cos cumsum div.Tensor div_.Tensor empty.memory_format eq.Scalar equal exp exp_ fill_.Scalar
    fill_.Tensor flip floor floor_divide gather ge.Scalar grid_sampler_2d gt.Scalar gt.Tensor index.Tensor isnan
    le.Scalar le.Tensor lerp.Scalar lerp.Tensor lerp_.Scalar lerp_.Tensor linalg_vector_norm log10 lt.Scalar lt.Tensor
    max_pool2d_with_indices max_pool2d_with_indices_backward maximum mean.dim minimum mm mul.Tensor mul_.Tensor
    native_batch_norm native_batch_norm_backward native_layer_norm native_layer_norm_backward neg normal_ permute
    pow.Scalar pow.Tensor_Scalar pow.Tensor_Tensor reciprocal reciprocal_ relu relu_ remainder.Tensor repeat round
    rsqrt scatter_add searchsorted.Tensor set_.source_Storage set_.source_Storage_storage_offset sigmoid_
    sigmoid_backward sin sqrt sqrt_ sub.Tensor sub_.Tensor sum.dim_IntList tanh tanh_ tanh_backward
    threshold_backward unfold unfold_backward uniform_ upsample_linear1d view view_as_complex view_as_real
    where.self zero_
"""
KERNELS = frozenset(_KERNELS.split())
"""Operators with a kernel for MPS."""

COMPOSITES = {
    # Views, copies and memory
    **dict.fromkeys(("_to_copy", "clone", "copy_", "lift_fresh"), ("empty_strided",)),
    **dict.fromkeys(("_unsafe_view", "alias", "detach", "expand", "t", "transpose.int", "transpose_"), ("as_strided",)),
    **dict.fromkeys(("as_strided_", "select.int", "slice.Tensor", "squeeze.dim", "squeeze_.dim"), ("as_strided",)),
    **dict.fromkeys(("unbind.int", "unsafe_split.Tensor", "unsqueeze", "split.Tensor"), ("as_strided",)),
    **dict.fromkeys(("empty_like", "new_empty", "new_empty_strided"), ("empty.memory_format", "empty_strided")),
    **dict.fromkeys(("new_zeros", "zeros", "zeros_like", "select_backward", "slice_backward"), ("zero_",)),
    **dict.fromkeys(("full", "full_like", "new_ones", "ones_like", "ones", "scalar_tensor"), ("fill_.Scalar",)),
    "stack": ("cat",),
    # Random numbers
    "randint": ("random_.from",),
    "randperm": ("randperm.generator_out",),
    "rand": ("uniform_",),
    "rand_like": ("uniform_",),
    **dict.fromkeys(("randn", "randn_like"), ("normal_",)),
    # Arithmetic
    "_foreach_mul_.Tensor": ("mul_.Tensor",),
    "_foreach_norm.Scalar": ("linalg_vector_norm",),
    "abs": ("abs.out",),
    "affine_grid_generator": ("linspace.out", "bmm", "mul_.Tensor"),
    "arange": ("arange.start_out",),
    "arange.start": ("arange.start_out",),
    "complex": ("complex.out",),
    "convolution": ("_mps_convolution",),
    "convolution_backward": ("mps_convolution_backward",),
    "div.Scalar": ("div.Tensor",),
    "fft_rfftfreq": ("arange.start_out", "mul_.Tensor"),
    "hann_window": ("arange.start_out", "mul_.Tensor", "cos_", "add_.Tensor"),
    "logical_and_": ("logical_and.out",),
    "linspace": ("linspace.out",),
    "masked_fill.Scalar": ("masked_fill_.Scalar",),
    "mean": ("mean.dim",),
    "mul.Scalar": ("mul.Tensor",),
    "remainder.Scalar": ("remainder.Tensor",),
    "rsub.Scalar": ("sub.Tensor",),
    "sort": ("sort.stable",),
    "sum": ("sum.dim_IntList",),
}
"""Operators without a kernel of any device, and the kernels that they come down to."""

IN_PLACE_OF_OTHERS = frozenset({"_lstm_mps", "lstm_mps_backward", "_mps_convolution", "mps_convolution_backward"})
"""Kernels that MPS uses where a CPU is seen using others."""
