/* Lets a test in Python be the chips: each transfer of the drivers is a call of a function that the test has set. */
#include "spi.h"

int (*on_read)(int chip, int first, uint8_t *data, int size);
int (*on_write)(int chip, int address, int value);
void (*on_delay)(int us);

bool board_spi_read(spi_chip chip, uint8_t first, uint8_t *data, size_t size) {
    return on_read((int)chip, first, data, (int)size) != 0;
}

bool board_spi_write(spi_chip chip, uint8_t address, uint8_t value) {
    return on_write((int)chip, address, value) != 0;
}

void board_delay_us(uint32_t us) {
    on_delay((int)us);
}
