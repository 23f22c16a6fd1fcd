"""GPU kernels in Triton for map optimization and alignment; they have not run on a GPU yet.

`make gpu-check` runs each kernel in the interpreter of Triton, compares it with the C++ kernels and
with the NumPy reference implementations, and compiles it for seven architectures. The service
uses the kernels if `service.device` selects a GPU. Importing this package does not import Triton,
but importing a module with kernels does.

- `arithmetic`: exponentials and logarithms, computed with IEEE operations alone.
- `projection`, `blending`: rendering of the image planes that the loss needs.
- `contributions`: median depth, and the contributions of the Gaussians to a rendering.
- `loss`, `block_means`: image loss with its derivatives, and the block means for the exposure.
- `projection_gradient`: derivatives with respect to the Gaussians, and a step of Adam.
- `residuals`: residuals of the alignment and sums of their normal equations.
- `arrays`: memory, sorting and sums, in NumPy for the interpreter and in torch for a GPU.
- `plane_rendering`, `frame_loss`, `descent`: functions that launch the kernels of one iteration.
- `view_rendering`: functions that launch the kernels of `contributions`.
- `equation_sums`: functions that launch the kernels of one step of the alignment.
- `device`: search for a GPU, and choice between it and the CPU.
- `benchmark_result`: saved results of `ldo bench --device cuda`, for this choice.
"""
