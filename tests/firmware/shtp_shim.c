/* Lets a test in Python be the hub: each transfer of the driver is a call of a function that the test has set. */
#include "shtp_bus.h"

int (*on_read)(uint8_t *data, int capacity);
int (*on_write)(const uint8_t *data, int size);
void (*on_delay)(int us);

size_t board_shtp_read(uint8_t *data, size_t capacity) {
    return (size_t)on_read(data, (int)capacity);
}

bool board_shtp_write(const uint8_t *data, size_t size) {
    return on_write(data, (int)size) != 0;
}

void board_delay_us(uint32_t us) {
    on_delay((int)us);
}
