/* Flash as chips have it, in the memory of an emulated one: erasing sets bits, programming clears them, both take time. */
#include "image.h"
#include "slots.h"

#define ERASE_US 20000u /* of a slot: a microcontroller's page takes 20 to 40 ms */
#define PROGRAM_US 50u  /* of a word */
#define WORD 4u

static bool read(void *context, uint32_t address, uint8_t *data, size_t size) {
    (void)context;
    if (!slots_hold(address, size)) {
        return false;
    }
    memcpy(data, image_bytes() + address, size);
    return true;
}

static bool erase(void *context, uint8_t slot) {
    volatile uint8_t *start;
    uint32_t at, i;
    (void)context;
    if (slot >= SLOTS) {
        return false;
    }
    start = image_bytes() + slot * BOARD_SLOT_SIZE;
    for (at = 0u; at < BOARD_SLOT_SIZE; at += IMAGE_ERASE_STEP) {
        for (i = at; i < at + IMAGE_ERASE_STEP; ++i) {
            start[i] = 0xFFu;
        }
        image_wait_us(ERASE_US * IMAGE_ERASE_STEP / BOARD_SLOT_SIZE);
    }
    return true;
}

static bool program(void *context, uint32_t address, const uint8_t *data, size_t size) {
    volatile uint8_t *start;
    size_t at;
    (void)context;
    if (!slots_hold(address, size)) {
        return false;
    }
    start = image_bytes() + address;
    for (at = 0u; at < size; ++at) {
        start[at] = (uint8_t)(start[at] & data[at]);
        if (at % WORD == WORD - 1u || at + 1u == size) {
            image_wait_us(PROGRAM_US);
        }
    }
    return true;
}

const mocap_flash *board_flash(void) {
    static const mocap_flash flash = {NULL, read, erase, program, BOARD_SLOT_SIZE};
    return &flash;
}

void board_unique_id(uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    memcpy(unique_id, image_bytes() + IMAGE_FACTORY_PAGE, MOCAP_UNIQUE_ID_SIZE);
}

bool board_are_writes_locked(void) {
    return image_bytes()[IMAGE_FACTORY_PAGE + MOCAP_UNIQUE_ID_SIZE] == 1u;
}

uint32_t image_first_count(void) {
    return mocap_get_u32(image_bytes() + IMAGE_FACTORY_PAGE + 16u);
}
