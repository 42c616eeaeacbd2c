"""An exported observer on a microcontroller: built for a Cortex-M4F, run under an emulator, its instructions counted.

    python tools/firmware.py FOLDER

FOLDER is what `covariant export … --real float -o FOLDER` wrote. Needs `arm-none-eabi-gcc` and `qemu-system-arm`. The
self-test of the export runs on an emulated board, and a second program makes one step more than a third: the difference
of their executed instructions is what a step takes. Both numbers are the same on every machine.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

FLAGS = [
    *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=c99", "-O2"),
    "-ffp-contract=fast",  # products and sums in one instruction, as the build file of an export has it
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Werror"),
]
BOARD = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-monitor", "none", "-semihosting-config"]
BOARD += ["enable=on,target=native"]
FLASH, MEMORY = 0x400000, 0x400000
"""Sizes [bytes] of the memories of the emulated board."""
STEPS = 2000
"""Steps of the program that counts; its instructions divided by this leave out its start."""


def built(folder: Path, name: str, sources: list[str], place: Path, program: str) -> Path:
    """A program for the board."""
    (place / "board.ld").write_text(_LINKER)
    (place / "board.c").write_text(_START)
    image = place / f"{program}.elf"
    files = [str(folder / f"{name}.c"), *sources]
    objects = []
    for k, file in enumerate(files):
        objects.append(str(place / f"{program}{k}.o"))
        subprocess.run(["arm-none-eabi-gcc", *FLAGS, f"-I{folder}", "-c", file, "-o", objects[-1]], check=True)
    start = str(place / "board.o")
    subprocess.run(["arm-none-eabi-gcc", *FLAGS[:4], "-O2", "-c", str(place / "board.c"), "-o", start], check=True)
    link = ["-T", str(place / "board.ld"), "-nostartfiles", "--specs=rdimon.specs"]
    subprocess.run(["arm-none-eabi-gcc", *FLAGS[:4], *link, start, *objects, "-lm", "-o", str(image)], check=True)
    return image


def ran(image: Path, *options: str) -> subprocess.CompletedProcess:
    """A program on the emulated board."""
    command = [*BOARD, *options, "-kernel", str(image)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def instructions(folder: Path, name: str, place: Path) -> float:
    """Instructions of a step: the clock of an emulator that takes a nanosecond for each."""
    counts = []
    for steps in (STEPS, 2 * STEPS):
        source = place / f"count{steps}.c"
        text = _COUNT.replace("@NAME@", name).replace("@UPPER@", name.upper())
        source.write_text(text.replace("@STEPS@", str(steps)))
        done = ran(built(folder, name, [str(source)], place, f"count{steps}"), "-icount", "shift=0,sleep=off")
        found = re.search(r"ticks (\d+)", done.stdout)
        if found is None:
            raise SystemExit(f"the program that counts says nothing: {done.stdout}{done.stderr}")
        counts.append(int(found.group(1)))
    # The timer of the board runs at 25 MHz, an instruction takes 1 ns of its time.
    return (counts[1] - counts[0]) * 40 / STEPS


def main(folder: Path) -> dict:
    """Run the self-test and count; raises `SystemExit` with one line where something is missing or wrong."""
    for tool in ("arm-none-eabi-gcc", "qemu-system-arm"):
        if shutil.which(tool) is None:
            raise SystemExit(f"{tool} is not installed")
    tests = list((folder / "test").glob("*_test.c"))
    if len(tests) != 1:
        raise SystemExit(f"{folder} is no folder that `covariant export` wrote")
    name = tests[0].stem.removesuffix("_test")
    with tempfile.TemporaryDirectory() as made:
        place = Path(made)
        image = built(folder, name, [str(tests[0])], place, "self_test")
        done = ran(image)
        if done.returncode or "ok" not in done.stdout:
            raise SystemExit(f"the self-test fails on the board: {done.stdout}{done.stderr}")
        count = instructions(folder, name, place)
    return {"name": name, "self_test": done.stdout.strip(), "instructions": round(count)}


_LINKER = """MEMORY { FLASH (rx) : ORIGIN = 0, LENGTH = 0x400000  RAM (rwx) : ORIGIN = 0x20000000, LENGTH = 0x400000 }
ENTRY(start)
SECTIONS {
    .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) . = ALIGN(4); } > FLASH
    .ARM.exidx : { *(.ARM.exidx*) } > FLASH
    .data : { data_begin = .; *(.data*) . = ALIGN(4); data_end = .; } > RAM AT > FLASH
    data_from = LOADADDR(.data);
    .bss : { bss_begin = .; __bss_start__ = .; *(.bss*) *(COMMON) . = ALIGN(4); bss_end = .; __bss_end__ = .; } > RAM
    . = ALIGN(8); end = .; __end__ = .;
    stack_top = ORIGIN(RAM) + LENGTH(RAM);
}
"""
_START = """#include <stdint.h>
#include <stdlib.h>
extern uint32_t data_begin, data_end, data_from, bss_begin, bss_end, stack_top;
extern int main(void);
extern void initialise_monitor_handles(void);
void start(void)
{
    uint32_t *from = &data_from, *to = &data_begin;
    while (to < &data_end)
        *to++ = *from++;
    for (to = &bss_begin; to < &bss_end; ++to)
        *to = 0;
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* the floating-point unit */
    initialise_monitor_handles();
    exit(main());
}
static void stop(void)
{
    exit(99);
}
void _init(void) {}
void _fini(void) {}
__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    &stack_top, (void *)start, (void *)stop, (void *)stop, (void *)stop, (void *)stop, (void *)stop,
};
"""
_COUNT = """#include "@NAME@.h"

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#define TIMER(offset) (*(volatile uint32_t *)(0x40000000u + (offset)))

int main(void)
{
    static @NAME@_state state;
    @NAME@_real y[@UPPER@_MEASUREMENTS];
    int i;
    uint32_t began;

    for (i = 0; i < @UPPER@_MEASUREMENTS; ++i)
        y[i] = (@NAME@_real)0.7;
    (void)@NAME@_init(&state, &@NAME@_default, y, 0);
    TIMER(8) = 0xFFFFFFFFu; /* counts down from here */
    TIMER(4) = 0xFFFFFFFFu;
    TIMER(0) = 1;
    began = TIMER(4);
    for (i = 0; i < @STEPS@; ++i) {
        y[0] += (@NAME@_real)1e-4;
        (void)@NAME@_step(&state, &@NAME@_default, NULL, y, NULL, (@NAME@_real)0.002);
    }
    printf("ticks %lu\\n", (unsigned long)(began - TIMER(4)));
    return 0;
}
"""

if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    print(json.dumps(main(Path(sys.argv[1]))))
