/* From reset to main on a Cortex-M3: memory set up, stack painted so that its deepest point can be found. */
#include <stddef.h>
#include <stdint.h>

#include "board_qemu.h"

#define PAINT 0xA5A5A5A5u

extern uint32_t data_source[], data_start[], data_end[], bss_start[], bss_end[], stack_low[], stack_high[];

int main(void);

__attribute__((noreturn)) void reset(void) {
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

/* A fault, or an interrupt that nobody asked for: wait for the watchdog. */
static void stuck(void) {
    for (;;) {
    }
}

#define INTERRUPTS 32

__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    void (*exceptions[15])(void);
    void (*interrupts[INTERRUPTS])(void);
} vectors = {
    stack_high,
    {reset, on_watchdog, stuck, stuck, stuck, stuck, 0, 0, 0, 0, stuck, stuck, 0, stuck, stuck},
    {on_uart_received, on_uart_sent, stuck, stuck, stuck, stuck, stuck, stuck, on_sampling_timer, on_idle_timer},
};
