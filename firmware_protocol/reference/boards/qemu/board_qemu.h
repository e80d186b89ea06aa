/* The start of the emulated board, and its interrupts. */
#ifndef MODULE_BOARD_QEMU_H
#define MODULE_BOARD_QEMU_H

/* Before anything of the module is called. */
void board_begin(void);

void on_watchdog(void);
void on_uart_received(void);
void on_uart_sent(void);
void on_sampling_timer(void);
void on_idle_timer(void);

#endif
