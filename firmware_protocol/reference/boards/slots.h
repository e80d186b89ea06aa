/* Where the slots of board.h lie in flash that is erased in larger sectors: each at the begin of a sector of its own. */
#ifndef MODULE_SLOTS_H
#define MODULE_SLOTS_H

#include "board.h"

#define SLOTS (BOARD_RESETS_SLOT + 1u)

/* Whether the slots have all of these bytes. */
static inline bool slots_hold(uint32_t address, size_t size) {
    const uint32_t end = SLOTS * BOARD_SLOT_SIZE;
    return address <= end && size <= end - address;
}

/* From the begin of the first sector, bytes. What is read or programmed at once lies within one slot. */
static inline uint32_t slots_place(uint32_t address, uint32_t sector_size) {
    return address / BOARD_SLOT_SIZE * sector_size + address % BOARD_SLOT_SIZE;
}

#endif
