/* A module in ten lines: one inertial sample, encoded and written to standard output as to a serial port. */
#include <stdio.h>

#include "mocap_protocol.h"

int main(void) {
    mocap_inertial_sample sample = {0};
    mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, MOCAP_KIND_INERTIAL_SAMPLE, 3, 17, 1250000, NULL, 0};
    uint8_t body[MOCAP_INERTIAL_SAMPLE_MAX_SIZE], sent[MOCAP_SENT_SIZE(MOCAP_INERTIAL_SAMPLE_MAX_SIZE)];
    mocap_inertial_sample_set_specific_force_si(&sample, 0.0f, 0.0f, 9.81f); /* m/s^2; at rest, z up */
    mocap_inertial_sample_set_angular_rate(&sample, 0, 94, 0);               /* the sensor's own steps */
    frame.body = body;
    frame.body_size = mocap_encode_inertial_sample(&sample, body, sizeof body);
    fwrite(sent, 1, mocap_encode_frame(&frame, sent, sizeof sent), stdout);
    return 0;
}
