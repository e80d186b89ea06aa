/* What the modules send, kept on the card: one file from each START to its STOP, of wire frames as they come on a line. */
#ifndef RELAY_RECORDER_H
#define RELAY_RECORDER_H

#include "mocap_protocol.h"

/* Looks what is on the card. */
void recorder_mount(void);

/* Ends the open file and begins another. False where the card is full, is none of ours, or there is none. */
bool recorder_begin(uint32_t time_us);

void recorder_end(void);

/* Appends to the open file, if there is one. False where the card is full: the file has then ended. */
bool recorder_write(const uint8_t *data, size_t size);

/* Brings what waits in memory to the card, once a second: more than that is not lost with the power. */
void recorder_work(uint32_t now_us);

#endif
