"""C++17 kernels bound with nanobind: small, checked, stateless, the GIL released.

Each kernel is compiled once per instruction set. The widest that the machine has is used;
`LDO_ISA=avx512|avx2|baseline` forces one. Results are bitwise equal for any number of threads,
and differ in the last bits between instruction sets.
"""

from ._rasterise import isa

__all__ = ["isa"]
