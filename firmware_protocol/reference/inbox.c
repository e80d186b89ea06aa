#include "inbox.h"

#define CAPACITY 512u /* powers of two: the indices run freely */
#define STAMPS 16u

/* All of it volatile: else the compiler might read what lies in the ring before it looks whether anything does. */
static volatile uint8_t ring[CAPACITY];
static volatile uint32_t stamps[STAMPS]; /* of the delimiters in the ring */
static volatile uint16_t put, got;
static volatile uint8_t stamps_put, stamps_got;

void inbox_on_byte(uint8_t byte) {
    static bool was_end;
    const bool is_end = byte == MOCAP_DELIMITER;
    if (is_end && was_end) {
        return; /* a line that is idle, or held low */
    }
    was_end = is_end;
    if ((uint16_t)(put - got) == CAPACITY || (is_end && (uint8_t)(stamps_put - stamps_got) == STAMPS)) {
        return; /* the checksum will tell, and the host asks again */
    }
    if (is_end) {
        stamps[stamps_put % STAMPS] = board_time_us();
        ++stamps_put;
    }
    ring[put % CAPACITY] = byte;
    ++put;
}

bool inbox_take(uint8_t *byte, uint32_t *came_us) {
    if (put == got) {
        return false;
    }
    *byte = ring[got % CAPACITY];
    if (*byte == MOCAP_DELIMITER) {
        *came_us = stamps[stamps_got % STAMPS];
        ++stamps_got;
    }
    ++got;
    return true;
}

bool inbox_is_empty(void) {
    return put == got;
}
