/* The memory card as a board gives it: numbered blocks, each written whole. A write that the power leaves unfinished may spoil its
 * block and no other. */
#ifndef RELAY_BLOCKS_H
#define RELAY_BLOCKS_H

#include <stdbool.h>
#include <stdint.h>

#define BLOCK_SIZE 512u

/* How many there are; 0 without a card. */
uint32_t board_blocks(void);

bool board_block_read(uint32_t number, uint8_t data[BLOCK_SIZE]);
bool board_block_write(uint32_t number, const uint8_t data[BLOCK_SIZE]);

#endif
