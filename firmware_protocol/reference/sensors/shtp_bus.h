/* The bus to a hub that speaks SHTP, of a board that has one: I2C or SPI, with its interrupt line. */
#ifndef SENSORS_SHTP_BUS_H
#define SENSORS_SHTP_BUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Takes what the hub has next, its head of four bytes included; what does not fit comes with the next call, under a head that says
 * so. How much it was; 0: nothing waits, or the bus failed. */
size_t board_shtp_read(uint8_t *data, size_t capacity);

bool board_shtp_write(const uint8_t *data, size_t size);

/* Lets at least so much time pass. */
void board_delay_us(uint32_t us);

#endif
