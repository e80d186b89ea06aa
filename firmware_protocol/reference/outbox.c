#include "outbox.h"

#define CAPACITY 1024u /* a power of two: the indices run freely */

static uint8_t ring[CAPACITY];
static volatile uint32_t put, sent;
static volatile size_t in_flight; /* bytes from `sent` on that the board is sending */

/* Gives the board the next stretch that does not wrap. Called with interrupts off. */
static void go_on(void) {
    const uint32_t start = sent % CAPACITY;
    const uint32_t left = put - sent;
    in_flight = left < CAPACITY - start ? left : CAPACITY - start;
    if (in_flight > 0u) {
        board_uart_send(ring + start, in_flight);
    }
}

bool outbox_put(const uint8_t *data, size_t size) {
    uint32_t before;
    size_t i;
    if (size > CAPACITY - (put - sent)) {
        return false;
    }
    for (i = 0u; i < size; ++i) {
        ring[(put + i) % CAPACITY] = data[i];
    }
    before = board_interrupts_off();
    put += (uint32_t)size;
    if (in_flight == 0u) {
        go_on();
    }
    board_interrupts_on(before);
    return true;
}

size_t outbox_size(void) {
    return put - sent;
}

void outbox_on_sent(void) {
    sent += (uint32_t)in_flight;
    go_on();
}
