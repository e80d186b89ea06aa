/* From reset to main on a Cortex-M: memory set up, stack painted so that its deepest point can be found. */
#include "start.h"
#include "board.h"

#include <stddef.h>

#define PAINT 0xA5A5A5A5u

extern uint32_t data_source[], data_start[], data_end[], bss_start[], bss_end[], stack_low[];

int main(void);

void reset(void) {
    uint32_t *from = data_source, *to;
    for (to = data_start; to < data_end;) {
        *to++ = *from++;
    }
    for (to = bss_start; to < bss_end;) {
        *to++ = 0u;
    }
    /* Below this frame all is free. */
    for (to = stack_low; to < (uint32_t *)__builtin_frame_address(0) - 16;) {
        *to++ = PAINT;
    }
    (void)main();
    for (;;) {
    }
}

size_t board_stack_used(void) {
    const uint32_t *deepest = stack_low;
    while (deepest < stack_high && *deepest == PAINT) {
        ++deepest;
    }
    return (size_t)((const uint8_t *)stack_high - (const uint8_t *)deepest);
}

uint32_t board_interrupts_off(void) {
    uint32_t before;
    __asm__ volatile("mrs %0, primask\n\tcpsid i" : "=r"(before)::"memory");
    return before;
}

void board_interrupts_on(uint32_t before) {
    __asm__ volatile("msr primask, %0" ::"r"(before) : "memory");
}

void stuck(void) {
    for (;;) {
    }
}
