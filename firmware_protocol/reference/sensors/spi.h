/* The bus to the sensors, of a board that has any: one transfer, a register address first. */
#ifndef SENSORS_SPI_H
#define SENSORS_SPI_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef enum { SPI_ICM42688, SPI_MMC5983 } spi_chip;

/* Reads `size` registers from `first` on. False where the bus failed. */
bool board_spi_read(spi_chip chip, uint8_t first, uint8_t *data, size_t size);
bool board_spi_write(spi_chip chip, uint8_t address, uint8_t value);

/* Lets at least so much time pass. */
void board_delay_us(uint32_t us);

#endif
