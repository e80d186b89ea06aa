/* The start of a Cortex-M board without a C library: what start.c gives, and what it asks of the board. */
#ifndef FREESTANDING_START_H
#define FREESTANDING_START_H

#include <stdint.h>

/* Named by the linker script. */
extern uint32_t stack_high[];

/* The first that runs: sets memory up and calls main(). */
__attribute__((noreturn)) void reset(void);

/* A fault, or an interrupt that nobody asked for: waits for the watchdog. */
void stuck(void);

/* Before anything of the module is called. */
void board_begin(void);

#endif
