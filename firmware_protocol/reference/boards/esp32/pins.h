/* What is wired where on an ESP32: change it here, and nowhere else. GPIO numbers, of a DevKitC or any board with an ESP32-WROOM. */
#ifndef ESP32_PINS_H
#define ESP32_PINS_H

/* To the host: UART0, which the USB socket of a DevKit leads to. */
#define PIN_UART_TX 1
#define PIN_UART_RX 3
#define BAUD 1000000u

/* SPI to the sensors: VSPI, on the pins that need no matrix. */
#define PIN_SPI_CLOCK 18
#define PIN_SPI_OUT 23 /* SDI of the chips */
#define PIN_SPI_IN 19  /* SDO of the chips */
#define PIN_SELECT_ICM42688 5
#define PIN_SELECT_MMC5983 21
#define SPI_HZ 5000000 /* both stand 10 MHz; wires of a bread board do not */

#define PIN_LIGHT 2 /* on when high; a DevKit has it on the board */

#define PIN_JUMPER 27 /* to ground: settings must not be changed */

#endif
