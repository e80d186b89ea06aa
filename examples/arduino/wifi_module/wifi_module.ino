/* A wireless sensor module from an ESP32 and an MPU-6050: 100 samples a second as UDP datagrams, answers to the
 * gateway's time requests, HELLO, GET_INFO and IDENTIFY (the light blinks).
 *
 * Copy firmware_protocol/c/mocap_protocol.h beside this file, give each module its own MODULE_ID, and name your
 * network and gateway. Any number of modules send to one port of the gateway, which answers each at its own address:
 *     links: [{name: wifi, url: "udp://0.0.0.0:7000?peers=192.168.4.0/24"}]
 *     rig: wifi_10         # modules 1 to 10
 *
 * To sign the link, make a key with `mocap-gateway config key wifi.key`, define its line as MOCAP_KEY below, and add
 * &key_file=wifi.key to the url. The module then obeys the gateway alone.
 */
#include <Arduino.h>
#include <WiFi.h>
#include <WiFiUdp.h>
#include <Wire.h>

#define MOCAP_CRC_BITWISE /* small before fast */
#include "mocap_protocol.h"

#ifndef MODULE_ID
#define MODULE_ID 1
#endif
#ifndef GATEWAY_HOST
#define GATEWAY_HOST "192.168.4.2"
#endif
#ifndef GATEWAY_PORT
#define GATEWAY_PORT 7000
#endif
#ifndef LED_BUILTIN
#define LED_BUILTIN 2
#endif
/* #define MOCAP_KEY "64 hexadecimal digits" */
#ifdef MOCAP_KEY
#include <Preferences.h>
#endif
static const char *const NETWORK = "suit", *const PASSWORD = "change me";

static const uint32_t SAMPLE_INTERVAL_US = 10000;
static const uint32_t INFO_INTERVAL_US = 5000000;
static const uint32_t HEALTH_INTERVAL_US = 1000000;

static const uint8_t MPU6050 = 0x68;
static const float METRES_PER_S2_A_STEP = 9.80665f / 2048.0f;     /* at +-16 g */
static const float RADIANS_PER_S_A_STEP = 0.01745329252f / 16.4f; /* at +-2000 deg/s */

static WiFiUDP gateway;
static uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE];
static uint16_t sample_sequence, info_sequence, health_sequence, sync_sequence, answer_sequence, samples_dropped;
static uint32_t sample_due, info_due, health_due, blinks_until_ms, samples_taken;
static uint8_t received[MOCAP_SENT_SIZE(MOCAP_COMMAND_MAX_SIZE)];
#ifdef MOCAP_KEY
static_assert(sizeof MOCAP_KEY == 2 * MOCAP_KEY_SIZE + 1, "MOCAP_KEY: 64 hexadecimal digits");
static mocap_signing signing;
static mocap_signed_decoder decoder;
static Preferences flash; /* the newest count of the gateway that a command had */
#else
static mocap_frame_decoder decoder;
#endif
static mocap_answer_memory answers;
static const mocap_answer *answer_to_send; /* later: answers to a broadcast must not collide */
static uint32_t answer_due;

static bool send_packet(uint8_t kind, uint16_t sequence, uint32_t time_us, const uint8_t *body, size_t size) {
  uint8_t sent[MOCAP_SENT_SIZE(MOCAP_ACKNOWLEDGEMENT_MAX_SIZE)];
  mocap_wire_frame frame = {MOCAP_PROTOCOL_VERSION, kind, MODULE_ID, sequence, time_us, body, size};
  const size_t sent_size = mocap_encode_frame(&frame, sent, sizeof sent);
  if (!gateway.beginPacket(GATEWAY_HOST, GATEWAY_PORT)) return false;
#ifdef MOCAP_KEY
  uint8_t signature[MOCAP_SENT_SIGNATURE_SIZE];
  gateway.write(signature, mocap_sign(&signing, sent, sent_size, signature));
#endif
  gateway.write(sent, sent_size); /* one whole frame a datagram */
  return gateway.endPacket() != 0;
}

static void begin_receiving() {
#ifdef MOCAP_KEY
  uint8_t key[MOCAP_KEY_SIZE];
  for (uint8_t i = 0; i < MOCAP_KEY_SIZE; ++i) {
    const char digits[3] = {MOCAP_KEY[2 * i], MOCAP_KEY[2 * i + 1], '\0'};
    key[i] = (uint8_t)strtoul(digits, NULL, 16);
  }
  flash.begin("mocap");
  mocap_signing_begin(&signing, key, mocap_crc32(0u, unique_id, sizeof unique_id), flash.getULong64("count", 0));
  signing.count = 0; /* after each restart too: the gateway answers with the count to go on from */
  mocap_signed_decoder_init(&decoder, &signing, received, sizeof received);
#else
  mocap_frame_decoder_init(&decoder, received, sizeof received);
#endif
}

static bool take_byte(uint8_t byte, mocap_wire_frame *frame) {
#ifdef MOCAP_KEY
  return mocap_signed_decoder_push(&decoder, byte, frame);
#else
  return mocap_frame_decoder_push(&decoder, byte, frame);
#endif
}

/* Before a command is obeyed: what was recorded of it is worth nothing after a restart either. */
static void keep_count() {
#ifdef MOCAP_KEY
  if (signing.host_newest > flash.getULong64("count", 0)) flash.putULong64("count", signing.host_newest);
#endif
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
  const uint16_t sequence = sample_sequence++; /* also of one that fails: the gateway counts the gap as lost */
  Wire.beginTransmission(MPU6050);
  Wire.write((uint8_t)0x3B);
  Wire.endTransmission(false);
  if (Wire.requestFrom(MPU6050, (uint8_t)14) != 14) return;
  for (uint8_t i = 0; i < 7; ++i) words[i] = read_word();
  mocap_inertial_sample_set_specific_force_si(&sample, words[0] * METRES_PER_S2_A_STEP,
      words[1] * METRES_PER_S2_A_STEP, words[2] * METRES_PER_S2_A_STEP);
  mocap_inertial_sample_set_angular_rate_si(&sample, words[4] * RADIANS_PER_S_A_STEP,
      words[5] * RADIANS_PER_S_A_STEP, words[6] * RADIANS_PER_S_A_STEP);
  ++samples_taken;
  if (!send_packet(MOCAP_KIND_INERTIAL_SAMPLE, sequence, now, body,
          mocap_encode_inertial_sample(&sample, body, sizeof body))) {
    ++samples_dropped;
  }
}

static void send_info(uint32_t now) {
  mocap_device_info info = {};
  uint8_t body[MOCAP_DEVICE_INFO_MAX_SIZE];
  memcpy(info.unique_id, unique_id, sizeof unique_id);
  info.firmware_version[0] = 1;
  info.accelerometer_range = mocap_device_info_accelerometer_range_from_si(16.0f * 9.80665f);
  info.gyroscope_range = mocap_device_info_gyroscope_range_from_si(2000.0f * 0.01745329252f);
  info.accelerometer_sampling_rate = mocap_device_info_accelerometer_sampling_rate_from_si(100.0f);
  info.gyroscope_sampling_rate = mocap_device_info_gyroscope_sampling_rate_from_si(100.0f);
  send_packet(MOCAP_KIND_DEVICE_INFO, info_sequence++, now, body, mocap_encode_device_info(&info, body, sizeof body));
}

static void send_health(uint32_t now) {
  mocap_health health = {};
  uint8_t body[MOCAP_HEALTH_MAX_SIZE];
  health.battery_percent = 255; /* not known, like voltage and temperature */
  health.battery_voltage = 65535;
  health.temperature_celsius = -32768;
  health.rssi_dbm = (int8_t)WiFi.RSSI();
  health.uptime_s = millis() / 1000u;
  health.samples_taken = samples_taken;
  health.samples_dropped = samples_dropped;
  send_packet(MOCAP_KIND_HEALTH, health_sequence++, now, body, mocap_encode_health(&health, body, sizeof body));
}

static void answer_time_request(const mocap_wire_frame *frame, uint32_t received_us) {
  mocap_sync_request request;
  mocap_sync_response response;
  uint8_t body[MOCAP_SYNC_RESPONSE_MAX_SIZE];
  if (mocap_decode_sync_request(frame->body, frame->body_size, &request) != MOCAP_GOOD) return;
  response.token = request.token;
  response.received_us = received_us;
  response.sent_us = micros();
  send_packet(MOCAP_KIND_SYNC_RESPONSE, sync_sequence++, response.sent_us, body,
      mocap_encode_sync_response(&response, body, sizeof body));
}

static void obey(const mocap_command *command, mocap_acknowledgement *answer, uint8_t *payload, size_t capacity) {
  mocap_hello_arguments hello;
  mocap_hello_payload chosen;
  mocap_identify_arguments identify;
  answer->result = MOCAP_RESULT_DONE;
  if (command->verb == MOCAP_VERB_HELLO &&
      mocap_decode_hello_arguments(command->arguments, command->arguments_size, &hello) == MOCAP_GOOD) {
    chosen.chosen = mocap_negotiate(hello.min_version, hello.max_version);
    chosen.min_version = MOCAP_LOWEST_VERSION;
    chosen.max_version = MOCAP_HIGHEST_VERSION;
    answer->payload = payload;
    answer->payload_size = mocap_encode_hello_payload(&chosen, payload, capacity);
  } else if (command->verb == MOCAP_VERB_IDENTIFY &&
      mocap_decode_identify_arguments(command->arguments, command->arguments_size, &identify) == MOCAP_GOOD) {
    blinks_until_ms = millis() + 1000u * identify.seconds;
  } else if (command->verb == MOCAP_VERB_GET_INFO) {
    info_due = health_due = micros(); /* with the answer */
  } else {
    answer->result = MOCAP_RESULT_NOT_SUPPORTED;
  }
}

static void take_command(const mocap_wire_frame *frame) {
  mocap_command command;
  mocap_acknowledgement answer = {};
  uint8_t payload[MOCAP_HELLO_PAYLOAD_MAX_SIZE];
  if (mocap_decode_command(frame->body, frame->body_size, &command) != MOCAP_GOOD ||
      !mocap_command_is_for(&command, frame->module, MODULE_ID, unique_id)) {
    return;
  }
  answer_to_send = mocap_find_answer(&answers, command.transaction, command.verb);
  if (answer_to_send == NULL) { /* a repeated command is answered, not obeyed again */
    answer.transaction = command.transaction;
    answer.verb = command.verb;
    memcpy(answer.unique_id, unique_id, sizeof unique_id);
    keep_count();
    obey(&command, &answer, payload, sizeof payload);
    answer_to_send = mocap_remember_answer(&answers, &answer);
  }
  answer_due = micros() + mocap_answer_delay_us(&command, frame->module, MODULE_ID);
}

static void receive() {
  mocap_wire_frame frame;
  while (gateway.parsePacket() > 0) {
    const uint32_t received_us = micros();
    while (gateway.available() > 0) {
      if (!take_byte((uint8_t)gateway.read(), &frame)) continue;
      if (frame.kind == MOCAP_KIND_COMMAND) {
        take_command(&frame);
      } else if (frame.kind == MOCAP_KIND_SYNC_REQUEST &&
          (frame.module == MODULE_ID || frame.module == MOCAP_BROADCAST)) {
        answer_time_request(&frame, received_us);
      }
    }
  }
}

static bool is_due(uint32_t now, uint32_t *due, uint32_t interval_us) {
  if ((int32_t)(now - *due) < 0) return false;
  *due += interval_us;
  return true;
}

void setup() {
  const uint64_t chip = ESP.getEfuseMac();
  memcpy(unique_id, &chip, sizeof chip);
  pinMode(LED_BUILTIN, OUTPUT);
  WiFi.begin(NETWORK, PASSWORD);
  WiFi.setSleep(false); /* or commands wait for a beacon */
  while (WiFi.status() != WL_CONNECTED) delay(100);
  gateway.begin(GATEWAY_PORT);
  Wire.begin();
  Wire.setClock(400000);
  write_register(0x6B, 0x01); /* awake, clock of the gyroscope */
  write_register(0x1A, 0x02); /* low-pass at 94 Hz */
  write_register(0x1B, 0x18); /* +-2000 deg/s */
  write_register(0x1C, 0x18); /* +-16 g */
  begin_receiving();
  sample_due = info_due = health_due = micros();
}

void loop() {
  receive();
  uint32_t now = micros();
  if (is_due(now, &sample_due, SAMPLE_INTERVAL_US)) send_sample(now);
  if (answer_to_send != NULL && (int32_t)(now - answer_due) >= 0) {
    send_packet(MOCAP_KIND_ACKNOWLEDGEMENT, answer_sequence++, now, answer_to_send->body, answer_to_send->size);
    answer_to_send = NULL;
  }
  if (is_due(now, &info_due, INFO_INTERVAL_US)) send_info(now);
  if (is_due(now, &health_due, HEALTH_INTERVAL_US)) send_health(now);
  digitalWrite(LED_BUILTIN, (int32_t)(blinks_until_ms - millis()) > 0 && millis() / 250u % 2u == 0u);
}
