/* Bytes from the line, with the time at which each wire frame ended: a time request is stamped by the interrupt. */
#ifndef MODULE_INBOX_H
#define MODULE_INBOX_H

#include "board.h"

/* The line brought a byte. Called from the board's interrupt. */
void inbox_on_byte(uint8_t byte);

/* The next byte; `came_us` is set where it is a delimiter. False where there is none. */
bool inbox_take(uint8_t *byte, uint32_t *came_us);

bool inbox_is_empty(void);

#endif
