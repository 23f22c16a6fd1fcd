"""Compilation of the GPU kernels for seven architectures, without a GPU.

    python -m tests.kernels.gpu.cubins [CAPABILITY...]

The program prints registers, stack and shared memory of each kernel as a table. It exits with
status 1 if a kernel uses a stack or spills registers, needs more registers than its limit, or
contains an instruction whose result differs between GPUs or runs: an approximation, a flush of
denormal numbers, TF32, a fused product and sum, or an atomic operation on floats. Shuffles are
allowed, because a lane reads a fixed other lane, so that sums have a fixed order. A kernel
must not depend on the values of its integers either, because a launch would then compile other
code than this program. At first the program compiles three kernels with such faults, and checks
that it detects them. Without arguments, it compiles for all of CAPABILITIES.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.pop("TRITON_INTERPRET", None)  # The interpreter would replace the compiler.
os.environ.setdefault("TRITON_CACHE_DIR", str(Path("build/triton").resolve()))

import triton
import triton.language as tl
from triton.backends.compiler import GPUTarget
from triton.backends.nvidia import compiler as nvidia
from triton.compiler import ASTSource

from ldo_service.kernels.gpu import (
    blending,
    block_means,
    contributions,
    equation_sums,
    loss,
    projection,
    projection_gradient,
    residuals,
)
from ldo_service.kernels.gpu.arithmetic import PINNED
from ldo_service.kernels.gpu.descent import CORRECTIONS
from ldo_service.kernels.gpu.frame_loss import PIXEL_LANES, ROW_SUMS
from ldo_service.kernels.gpu.plane_rendering import FOUR_WARPS, LANES

# Compute capabilities: Turing, A100, RTX 30, RTX 40, H100, B200, RTX 50. The Jetson Orin, 87, uses
# the same code as 86.
CAPABILITIES = (75, 80, 86, 89, 90, 100, 120)
TOOLS = Path(nvidia.__file__).parent / "bin"
FLOATS, INTS, BYTES, INT, FLOAT = "*fp32", "*i32", "*u8", "i32", "fp32"
DOUBLES = "*fp64"
SPARE_REGISTERS = 8
DIFFERING = re.compile(
    r"\b(fma\.|mad\.f|\S*\.approx|\S*\.ftz|div\.full|\S*tf32|(?:atom|red)\.\S*\.(?:b?f)\d)\S*"
)


@dataclass(frozen=True)
class Kernel:
    """A kernel as an iteration launches it.

    Attributes:
        function: The kernel.
        types: Types of its arguments without the constants.
        constants: Values of its constants.
        options: Options of the launch.
        registers: Registers for each of CAPABILITIES, of which SPARE_REGISTERS more are allowed.
    """

    function: Any
    types: tuple[str, ...]
    constants: Mapping[str, Any]
    options: Mapping[str, Any]
    registers: tuple[int, ...]

    @property
    def name(self) -> str:
        suffix = ", strips" if self.constants.get("WITH_STRIPS") else ""
        if self.function is block_means.block_means:
            suffix = f", {self.constants['LANES']} lanes"
        return self.function.__name__ + suffix


@triton.jit
def atomic_sum(values, out):
    """Add floats in the order in which the programs happen to run, a planted fault."""
    tl.atomic_add(out, tl.load(values + tl.program_id(0)))


KERNELS = (
    Kernel(
        projection.project_and_cull,
        (FLOATS, INT, FLOATS, INT, INT, FLOATS, INTS, INTS),
        {"BLOCK": LANES},
        FOUR_WARPS,
        (62, 62, 60, 60, 60, 59, 58),
    ),
    Kernel(
        projection.depth_keys,
        (FLOATS, INTS, INT, INTS),
        {"BLOCK": LANES},
        FOUR_WARPS,
        (10, 12, 12, 12, 12, 12, 10),
    ),
    Kernel(
        projection.list_pairs,
        (FLOATS, INTS, INTS, INTS, INT, INT, INTS, INTS),
        {"BLOCK": LANES},
        FOUR_WARPS,
        (64, 48, 48, 48, 56, 69, 56),
    ),
    Kernel(
        blending.blend_forward,
        (FLOATS, INTS, INTS, INTS, INT, INT, INT, FLOATS, INTS),
        {},
        blending.ONE_WARP,
        (99, 95, 102, 93, 89, 96, 95),
    ),
    Kernel(
        contributions.median_depths,
        (FLOATS, INTS, INTS, INTS, INT, INT, INT, FLOATS),
        {},
        blending.ONE_WARP,
        (58, 58, 58, 55, 55, 64, 58),
    ),
    Kernel(
        contributions.contribute,
        (FLOATS, INTS, INTS, INTS, INTS, INTS, INT, INT, INT, FLOATS, INTS),
        {},
        blending.ONE_WARP,
        (72, 72, 72, 69, 69, 80, 67),
    ),
    Kernel(
        contributions.add_pairs,
        (FLOATS, INTS, INT, INTS, INTS, FLOATS),
        {"BLOCK": LANES},
        FOUR_WARPS,
        (20, 19, 19, 19, 19, 19, 20),
    ),
    *(  # The lanes for images of up to 359, 679 and 1319 pixels width.
        Kernel(
            block_means.block_means,
            (FLOATS, INT, INT, INT, INT, INT, FLOATS),
            {"LANES": lanes},
            blending.ONE_WARP,
            registers,
        )
        for lanes, registers in (
            (64, (19, 19, 20, 20, 20, 20, 21)),
            (256, (36, 39, 42, 41, 40, 39, 39)),
            (1024, (111, 113, 106, 80, 95, 80, 80)),
        )
    ),
    Kernel(
        loss.means_along_rows,
        (FLOATS, BYTES, BYTES, FLOATS, INT, INT, FLOATS),
        {"BLOCK": PIXEL_LANES},
        ROW_SUMS,
        (64, 40, 48, 48, 47, 54, 48),
    ),
    Kernel(
        loss.ssim_derivatives,
        (FLOATS, INT, INT, FLOATS, FLOATS),
        {"BLOCK": PIXEL_LANES},
        FOUR_WARPS,
        (117, 115, 96, 96, 96, 102, 102),
    ),
    Kernel(
        loss.derivatives_along_rows,
        (FLOATS, INT, INT, FLOATS),
        {"BLOCK": PIXEL_LANES},
        FOUR_WARPS,
        (70, 54, 70, 70, 58, 58, 64),
    ),
    Kernel(
        loss.color_gradient,
        (FLOATS, BYTES, BYTES, FLOATS, FLOATS, INT, INT, FLOAT, FLOAT, FLOATS, FLOATS, FLOATS),
        {"BLOCK": PIXEL_LANES},
        FOUR_WARPS,
        (72, 72, 64, 64, 64, 70, 66),
    ),
    Kernel(
        loss.depth_gradient,
        (FLOATS, FLOATS, BYTES, INT, INT, FLOAT, FLOATS, FLOATS),
        {"BLOCK": PIXEL_LANES},
        FOUR_WARPS,
        (26, 25, 28, 28, 26, 26, 28),
    ),
    Kernel(
        blending.blend_backward,
        (FLOATS, INTS, INTS, INTS, INTS, INTS, INT, INT, INT, FLOATS, FLOATS, FLOATS),
        {},
        blending.BACKWARD,
        (128, 128, 128, 128, 128, 136, 144),
    ),
    Kernel(
        projection_gradient.project_backward,
        (
            FLOATS,
            FLOATS,
            INT,
            INT,
            INTS,
            INT,
            INTS,
            INTS,
            FLOATS,
            FLOATS,
            FLOATS,
            FLOATS,
            INTS,
            FLOATS,
            FLOATS,
            FLOAT,
            FLOAT,
            FLOAT,
            FLOAT,
            FLOAT,
            FLOAT,
            FLOATS,
            FLOATS,
        ),
        {"LAST_STEP": CORRECTIONS - 1, "ADAM": True, "BLOCK": LANES},
        FOUR_WARPS,
        (110, 113, 113, 113, 113, 116, 115),
    ),
    Kernel(
        residuals.sum_residuals,
        (FLOATS, INT, FLOATS, INT, INT, FLOATS, INT, FLOATS, FLOATS),
        {"WITH_STRIPS": False, "BLOCK": equation_sums.POINT_LANES},
        equation_sums.SUMMING,
        (162, 164, 163, 163, 165, 166, 155),
    ),
    Kernel(
        residuals.sum_residuals,
        (FLOATS, INT, FLOATS, INT, INT, FLOATS, INT, FLOATS, FLOATS),
        {"WITH_STRIPS": True, "BLOCK": equation_sums.POINT_LANES},
        equation_sums.SUMMING,
        (168, 168, 168, 168, 167, 168, 168),
    ),
    Kernel(
        residuals.add_programs,
        (FLOATS, INT, DOUBLES),
        {"LANES": equation_sums.SUM_LANES},
        blending.ONE_WARP,
        (40, 42, 42, 42, 42, 42, 34),
    ),
    Kernel(
        residuals.add_strips,
        (FLOATS, BYTES, INT, DOUBLES),
        {"LANES": equation_sums.STRIP_LANES},
        FOUR_WARPS,
        (64, 48, 48, 48, 48, 48, 48),
    ),
)


@dataclass(frozen=True)
class Compiled:
    """Properties of the machine code of a kernel.

    Attributes:
        registers: Registers of a thread.
        stack: Bytes of stack, plus the number of accesses to local memory.
        shared: Bytes of shared memory.
        shuffles: Number of shuffle instructions.
        differing: Instructions whose results differ between GPUs.
    """

    registers: int
    stack: int
    shared: int
    shuffles: int
    differing: tuple[str, ...]

    @property
    def cell(self) -> str:
        return f"{self.registers}/{self.stack}/{self.shared}"


def compiled(index: int, capability: int, changes: Mapping[str, Any] | None = None) -> Compiled:
    """Compile a kernel of KERNELS for an architecture, with changed options.

    Args:
        index: Place of the kernel in KERNELS.
        capability: Compute capability, such as 86.
        changes: Options that replace those of the kernel.
    """
    return compiled_kernel(KERNELS[index], capability, changes)


def compiled_kernel(
    kernel: Kernel, capability: int, changes: Mapping[str, Any] | None = None
) -> Compiled:
    names = kernel.function.arg_names
    types = (*kernel.types, *["constexpr"] * len(kernel.constants))
    aligned = {
        (i,): [["tt.divisibility", 16]] for i, kind in enumerate(types) if kind.startswith("*")
    }
    source = ASTSource(
        kernel.function,
        dict(zip(names, types, strict=True)),
        {(names.index(name),): value for name, value in kernel.constants.items()},
        aligned,
    )
    options = {**kernel.options, **(changes or {})}
    made = triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)
    return measured(made.asm["cubin"], made.asm["ptx"], made.metadata.shared)


def measured(cubin: bytes, ptx: str, shared: int) -> Compiled:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.cubin"
        path.write_bytes(cubin)
        usage = tool("cuobjdump", "--dump-resource-usage", str(path))
        sass = tool("nvdisasm", "-c", str(path))
    found = {key: int(n) for key, n in re.findall(r"(REG|STACK|LOCAL):(\d+)", usage)}
    differing = {match[0] for match in DIFFERING.finditer(ptx)}
    # Correct divisions and roots consist of fused instructions, which nothing else may use.
    if re.search(r"\bFFMA\b", sass) and not re.search(r"(div|sqrt)\.rn", ptx):
        differing.add("FFMA")
    spills = len(re.findall(r"\b(?:LDL|STL)\b", sass))
    return Compiled(
        found["REG"],
        found["STACK"] + found["LOCAL"] + spills,
        shared,
        len(re.findall(r"\bshfl\b", ptx)),
        tuple(sorted(differing)),
    )


def tool(name: str, *arguments: str) -> str:
    done = subprocess.run([TOOLS / name, *arguments], capture_output=True, text=True, check=True)
    return done.stdout


def faults_of(kernel: Kernel, capability: int, made: Compiled) -> list[str]:
    name = f"{kernel.name}, sm_{capability}"
    limit = kernel.registers[CAPABILITIES.index(capability)] + SPARE_REGISTERS
    faults = [f"{name}: {instruction}" for instruction in made.differing]
    if made.stack:
        faults.append(f"{name}: stack or spills, {made.stack}")
    if made.registers > limit:
        faults.append(f"{name}: {made.registers} registers, at most {limit} are allowed")
    return faults


def specialized_integers(kernel: Kernel) -> list[str]:
    """Return an error message for each integer whose value would make Triton compile again."""
    parameters = zip(kernel.function.params, kernel.types, strict=False)
    return [
        f"{kernel.name}: {parameter.name} is missing in SIZES of arithmetic.py"
        for parameter, kind in parameters
        if kind == INT and not parameter.do_not_specialize
    ]


def undetected_faults() -> list[str]:
    """Return an error message for each planted fault that is not detected.

    The planted faults are a kernel with too few registers, one with fused products and one with an
    atomic sum, compiled for sm_86, and one whose integers are specialized.
    """
    by_name = {kernel.name: i for i, kernel in enumerate(KERNELS)}
    spilling = compiled(by_name["blend_backward"], 86, {"maxnreg": 64})
    fused = compiled(by_name["blend_forward"], 86, {"enable_fp_fusion": True})
    assert PINNED["enable_fp_fusion"] is False
    forward = KERNELS[by_name["blend_forward"]]
    specialized = specialized_integers(replace(forward, function=triton.jit(forward.function.fn)))
    atomic = compiled_kernel(Kernel(atomic_sum, (FLOATS, FLOATS), {}, PINNED, ()), 86)
    missed = [] if spilling.stack else ["spilled registers were not detected"]
    missed += [] if fused.differing else ["fused products were not detected"]
    missed += [] if atomic.differing else ["atomic sums of floats were not detected"]
    return missed + ([] if len(specialized) == 3 else ["specialized integers were not detected"])


def main(arguments: list[str]) -> int:
    """Compile all kernels, print the table, and return the exit status."""
    faults, rows = undetected_faults(), []
    faults += [fault for kernel in KERNELS for fault in specialized_integers(kernel)]
    chosen = [c for c in CAPABILITIES if not arguments or str(c) in arguments]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for i, kernel in enumerate(KERNELS):
            made = list(pool.map(partial(compiled, i), chosen))
            for capability, result in zip(chosen, made, strict=True):
                faults += faults_of(kernel, capability, result)
            cells = " | ".join(result.cell for result in made)
            rows.append(f"| {kernel.name} | {kernel.options['num_warps']} | {cells} |")
            print(f"{kernel.name}: compiled, {made[0].shuffles} shuffles", file=sys.stderr)
    print("registers / stack and spills / bytes of shared memory")
    print("| kernel | warps | " + " | ".join(f"sm_{c}" for c in chosen) + " |")
    print("|---|---|" + "---|" * len(chosen))
    print("\n".join(rows))
    print("\n".join(faults) or "no stack, no spill, no instruction that differs between GPUs")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
