"""C++17 kernels, bound with nanobind: small functions that check their arguments.

The kernels release the GIL. Each kernel is compiled once per instruction set. The process uses the
widest instruction set of the machine; the environment variable `LDO_ISA=avx512|avx2|baseline`
forces one of them. Results are bitwise equal for any number of threads. Between instruction sets,
results differ in the last bits.
"""

from ldo_service.errors import ConfigError

try:
    from ._rasterize import isa
except ImportError as error:
    if "LDO_ISA" in str(error):
        raise ConfigError(f"the environment variable LDO_ISA cannot be used: {error}.") from error
    raise

__all__ = ["isa"]
