/* Evaluates a model on a board that QEMU emulates, and prints results, instructions and stack through semihosting. */
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "paper.h"
#include "samples.h"

extern void _start(void);
extern uint32_t stack_top;

/* The FPU is off after a reset; QEMU loads .data itself, and the library's _start clears .bss and calls main. */
void reset(void) {
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20;
    __asm volatile("dsb\n isb");
    _start();
}

__attribute__((section(".vectors"), used)) static void *const vectors[] = {&stack_top, (void *)reset};

/* With `-icount shift=0` an instruction takes 1 ns, and the timer, at 25 MHz, counts every fortieth. */
#define TIMER ((volatile uint32_t *)0xE000E010)
enum { RUNS = 50, PER_TICK = 40, PAINTED = 8192, PAINT = 0x5A5A5A5A };

static float next[PAPER_STATE_SIZE], dx[PAPER_STATE_SIZE][PAPER_STATE_SIZE], du[PAPER_STATE_SIZE][PAPER_INPUT_SIZE];

static void step(int i) { paper_step(X[i], U[i], next); }
static void jacobian(int i) { paper_step_jacobian(X[i], U[i], next, dx, du); }
static void nothing(int i) { (void)i; }

static uint32_t ticks(void (*call)(int)) {
    TIMER[1] = TIMER[2] = 0xFFFFFF;
    TIMER[0] = 5;
    const uint32_t before = TIMER[2];
    for (int i = 0; i < RUNS; ++i) { call(i % SAMPLES); }
    return before - TIMER[2];
}

static unsigned instructions(void (*call)(int)) { return (ticks(call) - ticks(nothing)) * PER_TICK / RUNS; }

/* Bytes of stack below this function that a call writes. */
static unsigned __attribute__((noinline)) stack(void (*call)(int)) {
    volatile uint32_t *low;
    __asm volatile("mov %0, sp" : "=r"(low));
    low -= PAINTED;
    for (int i = 0; i < PAINTED; ++i) { low[i] = PAINT; }
    call(0);
    int untouched = 0;
    while (untouched < PAINTED && low[untouched] == PAINT) { ++untouched; }
    return 4 * (PAINTED - untouched);
}

static void print(const float *values, int count) {
    for (int i = 0; i < count; ++i) {
        uint32_t bits;
        memcpy(&bits, values + i, 4);
        printf("%08lx ", (unsigned long)bits);
    }
}

int main(void) {
    for (int i = 0; i < SAMPLES; ++i) {
        jacobian(i);
        print(next, PAPER_STATE_SIZE);
        print(dx[0], PAPER_STATE_SIZE * PAPER_STATE_SIZE);
        print(du[0], PAPER_STATE_SIZE * PAPER_INPUT_SIZE);
    }
    printf("\n%u %u %u %u\n", instructions(step), instructions(jacobian), stack(step), stack(jacobian));
    return 0;
}
