/* Wire frames to and from the host, whatever carries them. wire_uart.c is a byte stream. */
#ifndef MODULE_WIRE_H
#define MODULE_WIRE_H

#include "mocap_protocol.h"

/* Longest body that can be sent; a relay is compiled with room for its batches. */
#ifndef WIRE_MOST_BODY
#define WIRE_MOST_BODY MOCAP_ACKNOWLEDGEMENT_MAX_SIZE
#endif

void wire_begin(void);

/* Sends a wire frame under a number of its own; false where the line is full. */
bool wire_send(uint8_t kind, uint16_t sequence, uint32_t time_us, const uint8_t *body, size_t size);

/* The same under the next number of its kind, which counts also what could not be sent. */
bool wire_report(uint8_t kind, uint32_t time_us, const uint8_t *body, size_t size);

/* Whether a sample may be queued: few bytes wait, so that an answer that comes next need not wait long. */
bool wire_is_ready(void);

/* How long what is queued will keep the line, us. */
uint32_t wire_busy_us(void);

/* The next wire frame from the host and when its end came; its body is good until the next call. */
bool wire_take(mocap_wire_frame *frame, uint32_t *came_us);

/* Whether there is nothing to take. */
bool wire_is_quiet(void);

/* The id under which the module sends. */
void wire_set_module(uint8_t module);
uint8_t wire_module(void);

#endif
