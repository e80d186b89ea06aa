/* ICM-42688-P of TDK InvenSense: accelerometer and gyroscope. Registers: data sheet DS-000347, user bank 0. */
#ifndef SENSORS_ICM42688_H
#define SENSORS_ICM42688_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint16_t accelerometer_range; /* set to, 0.1 m/s^2 */
    uint16_t gyroscope_range;     /* set to, deg/s */
    uint16_t rate_dhz;            /* at which the chip renews its readings, 0.1 Hz */
} icm42688_setup;

/* Resets it and sets the nearest ranges, and the lowest rate, that hold what is wanted. False: it does not answer. */
bool icm42688_configure(uint16_t accelerometer_range, uint16_t gyroscope_range, uint16_t rate_dhz,
                        icm42688_setup *setup);

/* The newest readings of accelerometer and gyroscope, in steps of the chip: full range is 32768. */
bool icm42688_read(int16_t acceleration[3], int16_t rate[3], int16_t *temperature_centidegrees);

#endif
