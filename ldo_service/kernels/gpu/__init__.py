"""GPU kernels in Triton for the optimization of the map; they have not run on a GPU yet.

`make gpu-check` runs each kernel in the interpreter of Triton, compares it with the C++ kernels and
with the NumPy reference implementations, and compiles it for seven architectures. The service
uses them if `service.device` selects a GPU. Importing this package imports no Triton; importing its
modules with kernels does.

- `arithmetic`: exponentials and logarithms of IEEE operations.
- `projection`, `blending`: rendering of the image planes that the loss needs.
- `loss`, `block_means`: image loss with its derivatives, and the block means for the exposure.
- `projection_gradient`: derivatives with respect to the Gaussians, and a step of Adam.
- `arrays`: memory, sorting and sums, in NumPy for the interpreter and in torch for a GPU.
- `plane_rendering`, `frame_loss`, `descent`: functions that launch the kernels of one iteration.
"""
