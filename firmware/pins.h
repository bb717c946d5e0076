/* Pins of a Raspberry Pi Pico. The wiring of the rig follows this table. */
#ifndef PINS_H
#define PINS_H

#define PIN_UART_TX 0       /* link, 460,800 baud, 3.3 V */
#define PIN_UART_RX 1
#define PIN_A 2             /* quadrature encoder, pulled up */
#define PIN_B 3
#define PIN_INDEX 4         /* index of the prism, high once per turn; weakly pulled down, the board's 10 kohm pull up */
#define PIN_CAMERA_SYNC 5   /* pulses of the camera (PULSES_CAMERA), pulled down */
#define PIN_TRIGGER 6       /* pulses to the camera's trigger input, 1 to 2 ms high */
#define PIN_PWM 8           /* motor driver: 25 kHz (AVR: 27 kHz) */
#define PIN_DIRECTION 9     /* high: forwards */
#define PIN_ENABLE 10       /* high: on */
#define PIN_DRIVER_FAULT 11 /* low: over-current or over-temperature, pulled up */
#define PIN_SUPPLY 12       /* supply of the motor, divided; low: lost. Pulled up: not connected means present */
#define PIN_SPI_MISO 16     /* magnetic encoder, 7.8 MHz, mode 1 */
#define PIN_SPI_CS 17
#define PIN_SPI_SCK 18
#define PIN_SPI_MOSI 19
#define PIN_LED 25          /* on while the motor is driven */
#define PIN_SUPPLY_ADC 26   /* supply of the motor by DIVIDER_UPPER and _LOWER: its voltage. Not connected means unknown */

/* Divider of the supply's voltage [ohm]: 12 V are 2.1 V at the pin, and 3.3 V are 18.8 V. The port for the AVR has the same. */
#define DIVIDER_UPPER 47000u
#define DIVIDER_LOWER 10000u

#endif
