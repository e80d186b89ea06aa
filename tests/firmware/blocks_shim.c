/* Lets a test in Python be the card of a relay: each block that is read or written is a call of a function that the test has set. */
#include "blocks.h"

int (*on_blocks)(void);
int (*on_read)(int number, uint8_t *data);
int (*on_write)(int number, const uint8_t *data);

uint32_t board_blocks(void) {
    return (uint32_t)on_blocks();
}

bool board_block_read(uint32_t number, uint8_t data[BLOCK_SIZE]) {
    return on_read((int)number, data) != 0;
}

bool board_block_write(uint32_t number, const uint8_t data[BLOCK_SIZE]) {
    return on_write((int)number, data) != 0;
}
