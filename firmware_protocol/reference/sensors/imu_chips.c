/* imu.h on an ICM-42688-P and an MMC5983MA: from the chips' steps to those of the wire, in whole numbers.
 *
 * Both are taken to be mounted with their axes along those of the case; a board that has them otherwise turns them here.
 */
#include "icm42688.h"
#include "imu.h"
#include "mmc5983.h"

/* Of a chip's step: the range over 32768, in steps of the wire, times 2^16. */
static int32_t acceleration_scale, rate_scale;
static int16_t temperature = -32768;

/* Step of the chip's count over that of the wire, 0.05 uT: 100 uT are 16384 counts. 2^16 * 2000 / 16384. */
#define FIELD_SCALE 8000

bool imu_configure(const mocap_settings *settings, imu_setup *setup) {
    icm42688_setup chip;
    if (!mmc5983_configure() || !icm42688_configure(settings->accelerometer_range, settings->gyroscope_range,
                                                    settings->sampling_rate, &chip)) {
        memset(setup, 0, sizeof *setup);
        return false;
    }
    setup->accelerometer_range = chip.accelerometer_range;
    setup->gyroscope_range = chip.gyroscope_range;
    setup->magnetometer_range = MMC5983_RANGE_UT;
    setup->accelerometer_rate = setup->gyroscope_rate = settings->sampling_rate;
    setup->magnetometer_rate = settings->sampling_rate < MMC5983_RATE_DHZ ? settings->sampling_rate : MMC5983_RATE_DHZ;
    /* The ranges of both are powers of two below those of the wire (16 g, 2000 deg/s): the scale is one, exactly. */
    acceleration_scale = chip.accelerometer_range > 1000u ? 65536 : chip.accelerometer_range > 500u ? 32768 :
                         chip.accelerometer_range > 250u ? 16384 : 8192;
    rate_scale = chip.gyroscope_range > 1500u ? 65536 : chip.gyroscope_range > 750u ? 32768 :
                 chip.gyroscope_range > 400u ? 16384 : chip.gyroscope_range > 200u ? 8192 :
                 chip.gyroscope_range > 100u ? 4096 : chip.gyroscope_range > 50u ? 2048 : 1024;
    return true;
}

/* value * scale / 2^16, to the nearest, halves away from zero. */
static int32_t scaled(int32_t value, int32_t scale) {
    const int64_t product = (int64_t)value * scale;
    return (int32_t)((product + (product < 0 ? -32768 : 32768)) / 65536);
}

#define END_OF_RANGE 32767

/* True where an axis stands at the end of the chip's range. */
static bool put(const int16_t from[3], int32_t scale, int16_t to[3]) {
    bool is_clipped = false;
    uint8_t i;
    for (i = 0u; i < 3u; ++i) {
        is_clipped = is_clipped || from[i] >= END_OF_RANGE || from[i] <= -END_OF_RANGE;
        to[i] = (int16_t)scaled(from[i], scale);
    }
    return is_clipped;
}

static bool read_field(imu_reading *reading) {
    int32_t field[3];
    uint8_t i;
    switch (mmc5983_read(field)) {
        case MMC5983_FAILED:
            return false;
        case MMC5983_NOTHING_NEW:
            return true;
        default:
            break;
    }
    reading->present |= MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD;
    for (i = 0u; i < 3u; ++i) {
        if (field[i] >= 131071 || field[i] <= -131071) {
            reading->clipped |= MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED;
        }
        reading->magnetic_field[i] = (int16_t)scaled(field[i], FIELD_SCALE);
    }
    return true;
}

bool imu_read(uint32_t time_us, imu_reading *reading) {
    int16_t acceleration[3], rate[3];
    (void)time_us;
    memset(reading, 0, sizeof *reading);
    if (!icm42688_read(acceleration, rate, &temperature)) {
        return false;
    }
    reading->present = MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE | MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE;
    if (put(acceleration, acceleration_scale, reading->specific_force)) {
        reading->clipped |= MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED;
    }
    if (put(rate, rate_scale, reading->angular_rate)) {
        reading->clipped |= MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED;
    }
    return read_field(reading);
}

int16_t imu_temperature(void) {
    return temperature;
}
