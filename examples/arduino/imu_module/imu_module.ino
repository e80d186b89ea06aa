/* A sensor module from an ESP32 or Arduino and an MPU-6050: 100 samples a second over the serial port, answers to
 * the gateway's time requests, and a word about itself now and then.
 *
 * Copy firmware_protocol/c/mocap_protocol.h beside this file. The gateway reads it with
 *     links: [{name: suit, url: "/dev/serial/by-id/…?baud=115200"}]
 *     rig: single          # one module, id 1
 */
#include <Arduino.h>
#include <Wire.h>

#define MOCAP_CRC_BITWISE /* small before fast */
#include "mocap_protocol.h"

static const uint8_t MODULE_ID = 1;
static const uint32_t BAUD = 115200;
static const uint32_t SAMPLE_INTERVAL_US = 10000;
static const uint32_t INFO_INTERVAL_US = 5000000;

static const uint8_t MPU6050 = 0x68;
static const float METRES_PER_S2_A_STEP = 9.80665f / 2048.0f;            /* at +-16 g */
static const float RADIANS_PER_S_A_STEP = 0.01745329252f / 16.4f;        /* at +-2000 deg/s */

static uint16_t sample_sequence, info_sequence, sync_sequence;
static uint32_t sample_due, info_due;
static uint8_t received[64];
static mocap_frame_decoder decoder;

static void send_packet(uint8_t kind, uint16_t sequence, uint32_t time_us, const uint8_t *body, size_t size) {
  uint8_t sent[MOCAP_SENT_SIZE(MOCAP_DEVICE_INFO_MAX_SIZE)];
  mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, kind, MODULE_ID, sequence, time_us, body, size};
  Serial.write(sent, mocap_encode_frame(&frame, sent, sizeof sent));
}

static void write_register(uint8_t address, uint8_t value) {
  Wire.beginTransmission(MPU6050);
  Wire.write(address);
  Wire.write(value);
  Wire.endTransmission();
}

static int16_t read_word() {
  const int high = Wire.read();
  return (int16_t)((high << 8) | Wire.read());
}

static void send_sample(uint32_t now) {
  mocap_inertial_sample sample = {};
  uint8_t body[MOCAP_INERTIAL_SAMPLE_MAX_SIZE];
  int16_t words[7]; /* acceleration, temperature, angular rate */
  Wire.beginTransmission(MPU6050);
  Wire.write((uint8_t)0x3B);
  Wire.endTransmission(false);
  if (Wire.requestFrom(MPU6050, (uint8_t)14) != 14) {
    ++sample_sequence; /* a gap in the numbers: the gateway counts it as lost */
    return;
  }
  for (uint8_t i = 0; i < 7; ++i) words[i] = read_word();
  mocap_inertial_sample_set_specific_force_si(&sample, words[0] * METRES_PER_S2_A_STEP,
      words[1] * METRES_PER_S2_A_STEP, words[2] * METRES_PER_S2_A_STEP);
  mocap_inertial_sample_set_angular_rate_si(&sample, words[4] * RADIANS_PER_S_A_STEP,
      words[5] * RADIANS_PER_S_A_STEP, words[6] * RADIANS_PER_S_A_STEP);
  send_packet(MOCAP_KIND_INERTIAL_SAMPLE, sample_sequence++, now, body,
      mocap_encode_inertial_sample(&sample, body, sizeof body));
}

static void send_info(uint32_t now) {
  mocap_device_info info = {};
  uint8_t body[MOCAP_DEVICE_INFO_MAX_SIZE];
#ifdef ESP32
  const uint64_t chip = ESP.getEfuseMac();
  memcpy(info.unique_id, &chip, sizeof chip);
#else
  info.unique_id[0] = MODULE_ID; /* boards without a number of their own: one here for each */
#endif
  info.firmware_version[0] = 1;
  info.accelerometer_range = mocap_device_info_accelerometer_range_from_si(16.0f * 9.80665f);
  info.gyroscope_range = mocap_device_info_gyroscope_range_from_si(2000.0f * 0.01745329252f);
  info.accelerometer_sampling_rate = mocap_device_info_accelerometer_sampling_rate_from_si(100.0f);
  info.gyroscope_sampling_rate = mocap_device_info_gyroscope_sampling_rate_from_si(100.0f);
  send_packet(MOCAP_KIND_DEVICE_INFO, info_sequence++, now, body, mocap_encode_device_info(&info, body, sizeof body));
}

static void answer(const mocap_wire_frame *frame, uint32_t received_us) {
  mocap_sync_request request;
  mocap_sync_response response;
  uint8_t body[MOCAP_SYNC_RESPONSE_MAX_SIZE];
  if (frame->kind != MOCAP_KIND_SYNC_REQUEST ||
      (frame->module != MODULE_ID && frame->module != MOCAP_BROADCAST) ||
      mocap_decode_sync_request(frame->body, frame->body_size, &request) != MOCAP_GOOD) {
    return;
  }
  response.token = request.token;
  response.received_us = received_us;
  response.sent_us = micros();
  send_packet(MOCAP_KIND_SYNC_RESPONSE, sync_sequence++, response.sent_us, body,
      mocap_encode_sync_response(&response, body, sizeof body));
}

void setup() {
  Serial.begin(BAUD);
  Wire.begin();
  Wire.setClock(400000);
  write_register(0x6B, 0x01); /* awake, clock of the gyroscope */
  write_register(0x1A, 0x02); /* low-pass at 94 Hz */
  write_register(0x1B, 0x18); /* +-2000 deg/s */
  write_register(0x1C, 0x18); /* +-16 g */
  mocap_frame_decoder_init(&decoder, received, sizeof received);
  sample_due = info_due = micros();
}

void loop() {
  mocap_wire_frame frame;
  while (Serial.available() > 0) {
    if (mocap_frame_decoder_push(&decoder, (uint8_t)Serial.read(), &frame)) answer(&frame, micros());
  }
  const uint32_t now = micros();
  if ((int32_t)(now - sample_due) >= 0) {
    sample_due += SAMPLE_INTERVAL_US;
    send_sample(now);
  }
  if ((int32_t)(now - info_due) >= 0) {
    info_due += INFO_INTERVAL_US;
    send_info(now);
  }
}
