"""C on the processors of flight controllers: it fits, and QEMU's board finds what this machine finds.

Needs Debian's gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm. With `pytest -s` it prints what it found;
QEMU counts instructions and knows nothing of cycles.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from compiled import C99, Library, needs_compiler, run
from fields import KEY, samples

import hybrid_jax as hj
from hybrid_jax.export import export_adaptation_c, export_c

BOARD = Path(__file__).parent / "board"
TOOLS = ("arm-none-eabi-gcc", "qemu-system-arm")
MISSING = [tool for tool in TOOLS if shutil.which(tool) is None]
pytestmark = [needs_compiler, pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}")]

# Processor → its FPU, and the board that has it in QEMU.
BOARDS = {"cortex-m7": ("fpv5-sp-d16", "mps2-an500"), "cortex-m4": ("fpv4-sp-d16", "mps2-an386")}
HYBRID = hj.Hybrid(hj.rigid_body(hj.IRIS), hj.residual_network(13, 4, KEY))
SAME = 1e-5  # of the largest entry: single precision, and another order of rounding if any


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    """Header and source of the paper's hybrid, 17 → 64 → 13."""
    folder = tmp_path_factory.mktemp("paper")
    (folder / "samples.h").write_text(header(*samples()))
    return export_c(folder, HYBRID, 0.01, name="paper")


def header(x, u):
    text = f"enum {{ SAMPLES = {len(x)} }};\n"
    for name, rows in (("X", x), ("U", u)):
        table = ", ".join("{" + ", ".join(f"{one:.9e}f" for one in row) + "}" for row in rows.astype(np.float32))
        text += f"static const float {name}[][{rows.shape[1]}] = {{{table}}};\n"
    return text


def target(processor):
    return (f"-mcpu={processor}", f"-mfpu={BOARDS[processor][0]}", "-mfloat-abi=hard", "-mthumb", "-O2")


def sizes_of(compiled):
    """Bytes of flash, and of the two kinds of static RAM."""
    return map(int, run("arm-none-eabi-size", compiled).splitlines()[1].split()[:3])


@pytest.mark.parametrize("processor", BOARDS)
def test_it_fits_and_finds_the_same(processor, paper):
    (_, board), (_, source) = BOARDS[processor], paper
    compiled, program = (source.with_name(f"{processor}{ending}") for ending in (".o", ".elf"))
    run("arm-none-eabi-gcc", *C99, *target(processor), "-c", source, "-o", compiled)
    link = ("-T", BOARD / "board.ld", "--specs=rdimon.specs", "-lm", "-o", program)
    run("arm-none-eabi-gcc", *target(processor), "-I", source.parent, BOARD / "main.c", compiled, *link)

    flash, *ram = sizes_of(compiled)
    assert flash + ram[0] <= 64 * 1024  # bytes
    assert sum(ram) == 0  # all is constant, or on the stack

    emulate = ("-nographic", "-monitor", "none", "-serial", "none", "-semihosting-config", "enable=on,target=native")
    said = run("qemu-system-arm", "-M", board, *emulate, "-icount", "shift=0", "-kernel", program).splitlines()
    found = np.array([int(word, 16) for word in said[0].split()], np.uint32).view(np.float32)
    library = Library(source, (13, 4), double=False)
    for row, x, u in zip(found.reshape(3, -1), *samples(), strict=True):
        parts = np.split(row, [13, 13 + 169])
        for part, expected in zip(parts, library("step_jacobian", x, u), strict=True):
            np.testing.assert_allclose(part, expected.ravel(), rtol=0, atol=SAME * abs(expected).max())

    step, jacobian, stack, stack_of_jacobian = map(int, said[1].split())
    assert 4 * (17 * 64 + 64 * 13) < step < jacobian  # no fewer than multiplications
    print(
        f"\n{processor}: flash {flash} B, static RAM {sum(ram)} B; a step: {step} instructions, {stack} B of stack; "
        f"with Jacobians: {jacobian} instructions, {stack_of_jacobian} B"
    )


def test_the_filter_of_physics_fits_on_a_stack(tmp_path):
    """The square root of its covariance is corrected 13 times, in arrays that are used again."""
    adaptation = hj.OnlineAdaptation(hj.rigid_body(hj.IRIS), 0.01, 1e-3, disturbance=2.0)
    source = export_adaptation_c(tmp_path, adaptation)[1]
    compiled = tmp_path / "filter.o"
    run("arm-none-eabi-gcc", *C99, *target("cortex-m4"), "-fstack-usage", "-c", source, "-o", compiled)
    flash, *ram = sizes_of(compiled)
    stack = max(int(line.split("\t")[1]) for line in compiled.with_suffix(".su").read_text().splitlines())
    print(f"\nfilter of physics: flash {flash} B, static RAM {sum(ram)} B, {stack} B of stack")
    assert sum(ram) == 0
    assert stack < 60_000
