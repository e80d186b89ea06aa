// The reference module on an ESP32, for the Arduino core 3: all that it is lies in the other files of this folder.
// `make -C firmware_protocol/reference arduino` lays them side by side, as the Arduino IDE wants them.
extern "C" void board_start(void);

void setup() {
    board_start();
}

void loop() {
    vTaskDelete(nullptr);  // the module has a task of its own
}
