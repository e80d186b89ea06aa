/* Bytes on their way to the line: a ring that the board empties in the background, as DMA does. */
#ifndef MODULE_OUTBOX_H
#define MODULE_OUTBOX_H

#include "board.h"

/* All of it or nothing; false where there is no room. */
bool outbox_put(const uint8_t *data, size_t size);

/* Bytes that the line has not sent yet. */
size_t outbox_size(void);

/* The board has sent what it was given. Called from its interrupt. */
void outbox_on_sent(void);

#endif
