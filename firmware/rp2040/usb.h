/* Serial port over the RP2040's own USB (CDC ACM). The main loop polls it, so that no interrupt is added to the encoder's. */
#ifndef USB_H
#define USB_H

#include <stdbool.h>
#include <stdint.h>

#define USB_PACKET 64u

void usb_begin(void);

/* Answer the host. `room`: bytes that on_usb_byte(), which the program defines, can take now. */
void usb_poll(uint32_t room);
void on_usb_byte(uint8_t byte);

bool usb_is_open(void);  /* whether a program has the port open (it sets DTR) */
bool usb_has_room(void); /* for a byte to send */
void usb_put(uint8_t byte);

#endif
