#include "reports.h"

#include "board.h"
#include "samples.h"
#include "store.h"
#include "wire.h"

#define INFO_INTERVAL_US 5000000u
#define HEALTH_INTERVAL_US 1000000u
#define HARDWARE_MAJOR 1u
#define FIRMWARE_MAJOR 1u

static imu_setup sensors;
static uint32_t info_due, health_due, last_us;
static uint32_t slept_us, awake_us; /* since the newest Health; of the second before it */
static uint64_t uptime_us; /* the counter wraps, this does not */

static void send_info(uint32_t now) {
    mocap_device_info info = {0};
    uint8_t body[MOCAP_DEVICE_INFO_MAX_SIZE];
    board_unique_id(info.unique_id);
    info.hardware_version[0] = HARDWARE_MAJOR;
    info.firmware_version[0] = FIRMWARE_MAJOR;
    info.accelerometer_range = sensors.accelerometer_range;
    info.gyroscope_range = sensors.gyroscope_range;
    info.magnetometer_range = sensors.magnetometer_range;
    info.accelerometer_sampling_rate = sensors.accelerometer_rate;
    info.gyroscope_sampling_rate = sensors.gyroscope_rate;
    info.magnetometer_sampling_rate = sensors.magnetometer_rate;
    (void)wire_report(MOCAP_KIND_DEVICE_INFO, now, body, mocap_encode_device_info(&info, body, sizeof body));
}

static void send_health(uint32_t now) {
    const sample_counts counts = samples_counted();
    mocap_health health = {0};
    uint8_t body[MOCAP_HEALTH_MAX_SIZE];
    health.battery_percent = 255u; /* not known, as is what follows; a board with a battery measures it */
    health.battery_voltage = 65535u;
    health.rssi_dbm = 127;
    health.temperature_celsius = imu_temperature();
    health.uptime_s = (uint32_t)(uptime_us / 1000000u);
    health.samples_taken = counts.taken;
    health.samples_dropped = counts.dropped;
    health.sensor_errors = counts.failed;
    health.resets = store_resets();
    (void)wire_report(MOCAP_KIND_HEALTH, now, body, mocap_encode_health(&health, body, sizeof body));
}

static bool is_due(uint32_t now, uint32_t *due, uint32_t interval_us) {
    if ((int32_t)(now - *due) < 0) {
        return false;
    }
    *due += interval_us;
    return true;
}

void reports_begin(const imu_setup *setup) {
    sensors = *setup;
    info_due = health_due = last_us = board_time_us();
}

void reports_set_setup(const imu_setup *setup) {
    sensors = *setup;
}

uint32_t reports_work(void) {
    const uint32_t now = board_time_us();
    uint32_t to_info, to_health;
    uptime_us += now - last_us;
    last_us = now;
    if (is_due(now, &info_due, INFO_INTERVAL_US)) {
        send_info(now);
    }
    if (is_due(now, &health_due, HEALTH_INTERVAL_US)) {
        awake_us = slept_us < HEALTH_INTERVAL_US ? HEALTH_INTERVAL_US - slept_us : 0u;
        slept_us = 0u;
        send_health(now);
    }
    to_info = info_due - now;
    to_health = health_due - now;
    return to_info < to_health ? to_info : to_health;
}

void reports_slept(uint32_t us) {
    slept_us += us;
}

void reports_introduce(void) {
    const uint32_t now = board_time_us();
    send_info(now);
    send_health(now);
    reports_log(MOCAP_LOG_LINE_LEVEL_DEBUG, "awake, us of the last second: ", awake_us);
    if (board_stack_used() > 0u) {
        reports_log(MOCAP_LOG_LINE_LEVEL_DEBUG, "stack, most bytes in use: ", (uint32_t)board_stack_used());
    }
}

void reports_event(uint8_t event, uint8_t value) {
    const mocap_event happened = {event, value};
    uint8_t body[MOCAP_EVENT_MAX_SIZE];
    (void)wire_report(MOCAP_KIND_EVENT, board_time_us(), body, mocap_encode_event(&happened, body, sizeof body));
}

void reports_log(uint8_t level, const char *text, uint32_t number) {
    mocap_log_line line;
    uint8_t body[MOCAP_LOG_LINE_MAX_SIZE], words[80];
    size_t size = 0u;
    while (text[size] != '\0' && size < sizeof words - 10u) {
        words[size] = (uint8_t)text[size];
        ++size;
    }
    if (number != REPORTS_NO_NUMBER) {
        uint32_t scale = 1u;
        while (number / scale >= 10u) {
            scale *= 10u;
        }
        for (; scale > 0u; scale /= 10u) {
            words[size++] = (uint8_t)('0' + number / scale % 10u);
        }
    }
    line.level = level;
    line.text = words;
    line.text_size = size;
    (void)wire_report(MOCAP_KIND_LOG_LINE, board_time_us(), body, mocap_encode_log_line(&line, body, sizeof body));
}
