/* The relay's memory card as a file of this computer: named by RELAY_CARD, RELAY_CARD_BLOCKS blocks long (64 MB where it is not
 * said). Without a name there is no card. */
#define _XOPEN_SOURCE 700
#include "blocks.h"

#include <fcntl.h>
#include <stdlib.h>
#include <unistd.h>

#define USUAL_BLOCKS 131072u

static int card = -1;
static uint32_t n_blocks;
static bool is_looked_for;

static void look(void) {
    const char *name = getenv("RELAY_CARD"), *size = getenv("RELAY_CARD_BLOCKS");
    is_looked_for = true;
    if (name == NULL) {
        return;
    }
    card = open(name, O_RDWR | O_CREAT | O_CLOEXEC, 0644);
    n_blocks = size == NULL ? USUAL_BLOCKS : (uint32_t)strtoul(size, NULL, 10);
    if (card < 0 || ftruncate(card, (off_t)n_blocks * (off_t)BLOCK_SIZE) != 0) {
        n_blocks = 0u;
    }
}

uint32_t board_blocks(void) {
    if (!is_looked_for) {
        look();
    }
    return n_blocks;
}

bool board_block_read(uint32_t number, uint8_t data[BLOCK_SIZE]) {
    return pread(card, data, BLOCK_SIZE, (off_t)number * (off_t)BLOCK_SIZE) == (ssize_t)BLOCK_SIZE;
}

bool board_block_write(uint32_t number, const uint8_t data[BLOCK_SIZE]) {
    return pwrite(card, data, BLOCK_SIZE, (off_t)number * (off_t)BLOCK_SIZE) == (ssize_t)BLOCK_SIZE;
}
