/* The inertial sensors, whatever chips they are: configured by the settings, read in the timer interrupt.
 *
 * Readings are in steps of mocap_inertial_sample, turned into the axes drawn on the case, and neither filtered nor
 * corrected: that is the gateway's business.
 */
#ifndef MODULE_IMU_H
#define MODULE_IMU_H

#include "mocap_protocol.h"

typedef struct {
    uint8_t present; /* MOCAP_INERTIAL_SAMPLE_HAS_...: a sensor without a new reading is left out */
    uint8_t clipped; /* MOCAP_INERTIAL_SAMPLE_..._CLIPPED: an axis stands at the end of the sensor's range */
    int16_t specific_force[3];
    int16_t angular_rate[3];
    int16_t magnetic_field[3];
} imu_reading;

/* What the chips were really set to, in the units of mocap_device_info; 0: there is no such sensor. */
typedef struct {
    uint16_t accelerometer_range, gyroscope_range, magnetometer_range;
    uint16_t accelerometer_rate, gyroscope_rate, magnetometer_rate;
} imu_setup;

/* Takes the nearest range that holds what the settings ask for. False when a chip does not answer. */
bool imu_configure(const mocap_settings *settings, imu_setup *setup);

/* Reads what is new at this time of the module's counter. Called from the timer interrupt. False: the reading failed. */
bool imu_read(uint32_t time_us, imu_reading *reading);

/* Of the chip, in steps of mocap_health; -32768: not known. */
int16_t imu_temperature(void);

#endif
