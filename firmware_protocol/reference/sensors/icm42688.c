#include "icm42688.h"

#include "spi.h"

#define DEVICE_CONFIG 0x11u
#define SOFT_RESET 0x01u
#define TEMP_DATA1 0x1Du /* temperature, acceleration, rate: seven words, high byte first */
#define PWR_MGMT0 0x4Eu
#define LOW_NOISE_BOTH 0x0Fu
#define GYRO_CONFIG0 0x4Fu
#define ACCEL_CONFIG0 0x50u
#define WHO_AM_I 0x75u
#define IDENTITY 0x47u

#define RESET_US 1000u    /* until it may be written to again */
#define SETTLES_US 45000u /* the gyroscope, once it is switched on */

typedef struct {
    uint16_t largest;
    uint8_t code;
} choice;

/* The smallest that holds what is wanted stands first. */
static const choice accelerometer_ranges[] = {{196u, 3u}, {392u, 2u}, {785u, 1u}, {1569u, 0u}};
static const choice gyroscope_ranges[] = {{31u, 6u}, {62u, 5u}, {125u, 4u}, {250u, 3u}, {500u, 2u}, {1000u, 1u}, {2000u, 0u}};
static const choice rates[] = {{125u, 11u}, {250u, 10u}, {500u, 9u}, {1000u, 8u}, {2000u, 7u}, {5000u, 15u}, {10000u, 6u},
                               {20000u, 5u}, {40000u, 4u}};

static choice nearest(const choice *choices, uint8_t count, uint16_t wanted) {
    uint8_t i = 0u;
    while (i + 1u < count && choices[i].largest < wanted) {
        ++i;
    }
    return choices[i];
}

bool icm42688_configure(uint16_t accelerometer_range, uint16_t gyroscope_range, uint16_t rate_dhz,
                        icm42688_setup *setup) {
    const choice accelerometer = nearest(accelerometer_ranges, 4u, accelerometer_range);
    const choice gyroscope = nearest(gyroscope_ranges, 7u, gyroscope_range);
    const choice rate = nearest(rates, 9u, rate_dhz);
    uint8_t identity = 0u;
    if (!board_spi_write(SPI_ICM42688, DEVICE_CONFIG, SOFT_RESET)) {
        return false;
    }
    board_delay_us(RESET_US);
    if (!board_spi_read(SPI_ICM42688, WHO_AM_I, &identity, 1u) || identity != IDENTITY) {
        return false;
    }
    /* Ranges and rates are set before the sensors run: a change under way gives some wrong readings. */
    if (!board_spi_write(SPI_ICM42688, GYRO_CONFIG0, (uint8_t)(gyroscope.code << 5 | rate.code)) ||
        !board_spi_write(SPI_ICM42688, ACCEL_CONFIG0, (uint8_t)(accelerometer.code << 5 | rate.code)) ||
        !board_spi_write(SPI_ICM42688, PWR_MGMT0, LOW_NOISE_BOTH)) {
        return false;
    }
    board_delay_us(SETTLES_US);
    setup->accelerometer_range = accelerometer.largest;
    setup->gyroscope_range = gyroscope.largest;
    setup->rate_dhz = rate.largest;
    return true;
}

static int16_t word(const uint8_t *data) {
    const int32_t v = data[0] << 8 | data[1];
    return (int16_t)(v < 0x8000 ? v : v - 0x10000);
}

bool icm42688_read(int16_t acceleration[3], int16_t rate[3], int16_t *temperature_centidegrees) {
    uint8_t data[14], i;
    if (!board_spi_read(SPI_ICM42688, TEMP_DATA1, data, sizeof data)) {
        return false;
    }
    /* T = raw / 132.48 + 25 degC */
    *temperature_centidegrees = (int16_t)((int32_t)word(data) * 10000 / 13248 + 2500);
    for (i = 0u; i < 3u; ++i) {
        acceleration[i] = word(data + 2 + 2 * i);
        rate[i] = word(data + 8 + 2 * i);
        if (acceleration[i] == -32768 || rate[i] == -32768) {
            return false; /* how the chip says that it has no reading yet */
        }
    }
    return true;
}
