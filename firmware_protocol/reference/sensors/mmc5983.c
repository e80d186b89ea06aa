#include "mmc5983.h"

#include "spi.h"

#define XOUT0 0x00u /* six bytes of two high parts each axis, then the two lowest bits of all three */
#define STATUS 0x08u
#define MEASURED 0x01u /* written as 1 it is cleared */
#define CONTROL0 0x09u
#define AUTO_SET_RESET 0x20u
#define CONTROL1 0x0Au
#define SOFT_RESET 0x80u
#define BANDWIDTH_200HZ 0x01u /* a measurement takes 4 ms */
#define CONTROL2 0x0Bu
#define CONTINUOUS_100HZ 0x0Du /* CMM_EN, 101: 100 Hz */
#define PERIODIC_SET 0x80u     /* with PRD_SET 000: at each measurement */
#define PRODUCT_ID 0x2Fu
#define IDENTITY 0x30u

#define RESET_US 10000u
#define ZERO_FIELD 131072

bool mmc5983_configure(void) {
    uint8_t identity = 0u;
    if (!board_spi_write(SPI_MMC5983, CONTROL1, SOFT_RESET)) {
        return false;
    }
    board_delay_us(RESET_US);
    return board_spi_read(SPI_MMC5983, PRODUCT_ID, &identity, 1u) && identity == IDENTITY &&
           board_spi_write(SPI_MMC5983, CONTROL0, AUTO_SET_RESET) &&
           board_spi_write(SPI_MMC5983, CONTROL1, BANDWIDTH_200HZ) &&
           board_spi_write(SPI_MMC5983, CONTROL2, CONTINUOUS_100HZ | PERIODIC_SET);
}

mmc5983_reading mmc5983_read(int32_t field[3]) {
    uint8_t status = 0u, data[7], i;
    if (!board_spi_read(SPI_MMC5983, STATUS, &status, 1u)) {
        return MMC5983_FAILED;
    }
    if ((status & MEASURED) == 0u) {
        return MMC5983_NOTHING_NEW;
    }
    if (!board_spi_read(SPI_MMC5983, XOUT0, data, sizeof data) || !board_spi_write(SPI_MMC5983, STATUS, MEASURED)) {
        return MMC5983_FAILED;
    }
    for (i = 0u; i < 3u; ++i) {
        const uint32_t low = data[6] >> (6u - 2u * i) & 3u;
        field[i] = (int32_t)((uint32_t)data[2u * i] << 10 | (uint32_t)data[2u * i + 1u] << 2 | low) - ZERO_FIELD;
    }
    return MMC5983_NEW;
}
