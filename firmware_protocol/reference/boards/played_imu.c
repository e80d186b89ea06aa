/* Sensors that feel a motion from the memory image, for boards without any: what is read is known beforehand.
 *
 * Between two rows the readings are interpolated; before the first and after the last they stay. Without a motion the module
 * lies still, z up, in a field that dips by 66 degrees.
 */
#include "image.h"
#include "imu.h"

#define ROW_NUMBERS 9u
#define ROW_SIZE (ROW_NUMBERS * 2u)
#define HEAD_SIZE 16u
#define MAGNETOMETER_DHZ 1000u /* its fastest: a module that samples faster has a field in some samples alone */
#define TEMPERATURE 2500       /* 0.01 degC */
#define ONE_G 2048             /* steps */

/* Ranges that the chips have, in the units of mocap_device_info; the smallest that holds what is wanted is taken. */
static const uint16_t accelerometer_ranges[] = {196u, 392u, 785u, 1569u};
static const uint16_t gyroscope_ranges[] = {125u, 250u, 500u, 1000u, 2000u};
static const uint16_t magnetometer_ranges[] = {800u, 1600u};

static int32_t accelerometer_limit, gyroscope_limit, magnetometer_limit; /* steps */
static uint32_t field_interval_us, last_field_us, first_us;
static bool has_field, has_begun;

static uint16_t nearest(const uint16_t *ranges, size_t n, uint16_t wanted) {
    size_t i = 0u;
    while (i + 1u < n && ranges[i] < wanted) {
        ++i;
    }
    return ranges[i];
}

bool imu_configure(const mocap_settings *settings, imu_setup *setup) {
    const uint16_t rate = settings->sampling_rate;
    setup->accelerometer_range = nearest(accelerometer_ranges, 4u, settings->accelerometer_range);
    setup->gyroscope_range = nearest(gyroscope_ranges, 5u, settings->gyroscope_range);
    setup->magnetometer_range = nearest(magnetometer_ranges, 2u, settings->magnetometer_range);
    setup->accelerometer_rate = setup->gyroscope_rate = rate;
    setup->magnetometer_rate = rate < MAGNETOMETER_DHZ ? rate : MAGNETOMETER_DHZ;
    accelerometer_limit = (int32_t)setup->accelerometer_range * 20884 / 1000;
    gyroscope_limit = (int32_t)setup->gyroscope_range * 16384 / 1000;
    magnetometer_limit = (int32_t)setup->magnetometer_range * 20;
    /* Half a sample's time early: an interval that is just too short must not leave out every other one. */
    field_interval_us = 10000000u / setup->magnetometer_rate - 5000000u / rate;
    has_field = false;
    if (!has_begun) {
        has_begun = true;
        first_us = image_first_count();
    }
    return true;
}

/* Row `place` and so many 65536ths on towards the next. */
static void row_at(uint32_t time_us, int32_t row[ROW_NUMBERS]) {
    static const int16_t lying[ROW_NUMBERS] = {0, 0, ONE_G, 0, 399, -895, 0, 0, 0};
    const uint8_t *motion = image_bytes() + IMAGE_MOTION;
    const uint32_t interval = mocap_get_u32(motion + 4), rows = mocap_get_u32(motion + 8);
    uint32_t place, part, i;
    if (memcmp(motion, "MOTN", 4u) != 0 || rows == 0u || interval == 0u) {
        for (i = 0u; i < ROW_NUMBERS; ++i) {
            row[i] = lying[i];
        }
        return;
    }
    place = (time_us - first_us) / interval;
    part = (uint32_t)((uint64_t)((time_us - first_us) % interval) * 65536u / interval);
    if (place + 1u >= rows) {
        place = rows - 1u;
        part = 0u;
    }
    for (i = 0u; i < ROW_NUMBERS; ++i) {
        const uint8_t *here = motion + HEAD_SIZE + place * ROW_SIZE + i * 2u;
        const int64_t from = mocap_get_i16(here), to = part > 0u ? mocap_get_i16(here + ROW_SIZE) : from;
        row[i] = (int32_t)(from + ((to - from) * (int64_t)part + (to < from ? -32768 : 32768)) / 65536);
    }
}

/* Limits a reading as the chip does; true where an axis stands at the end. */
static bool limit(const int32_t from[3], int32_t limit, int16_t to[3]) {
    bool is_clipped = false;
    size_t i;
    limit = limit < 32767 ? limit : 32767;
    for (i = 0u; i < 3u; ++i) {
        const bool is_beyond = from[i] >= limit || from[i] <= -limit;
        is_clipped = is_clipped || is_beyond;
        to[i] = (int16_t)(from[i] >= limit ? limit : from[i] <= -limit ? -limit : from[i]);
    }
    return is_clipped;
}

bool imu_read(uint32_t time_us, imu_reading *reading) {
    int32_t row[ROW_NUMBERS];
    row_at(time_us, row);
    reading->present = MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE | MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE;
    reading->clipped = 0u;
    memset(reading->magnetic_field, 0, sizeof reading->magnetic_field);
    if (limit(row, accelerometer_limit, reading->specific_force)) {
        reading->clipped |= MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED;
    }
    if (limit(row + 6, gyroscope_limit, reading->angular_rate)) {
        reading->clipped |= MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED;
    }
    if (!has_field || time_us - last_field_us >= field_interval_us) {
        has_field = true;
        last_field_us = time_us;
        reading->present |= MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD;
        if (limit(row + 3, magnetometer_limit, reading->magnetic_field)) {
            reading->clipped |= MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED;
        }
    }
    return true;
}

int16_t imu_temperature(void) {
    return TEMPERATURE;
}
