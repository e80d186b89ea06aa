/* A relay has no inertial sensors of its own. */
#include "imu.h"

bool imu_configure(const mocap_settings *settings, imu_setup *setup) {
    (void)settings;
    memset(setup, 0, sizeof *setup);
    return true;
}

bool imu_read(uint32_t time_us, imu_reading *reading) {
    (void)time_us;
    (void)reading;
    return false;
}

int16_t imu_temperature(void) {
    return -32768;
}
