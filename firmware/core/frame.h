/* Frames of the serial link: COBS, CRC-32 and sequence numbers. */
#ifndef FRAME_H
#define FRAME_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#define HEADER_BYTES 4u
#define CRC_BYTES 4u
#define LONGEST_COMMAND 24u /* longest packet that is a known command, with header and CRC, and some more [bytes] */

static inline void put16(uint8_t *to, uint32_t value) { to[0] = (uint8_t)value, to[1] = (uint8_t)(value >> 8); }
static inline void put32(uint8_t *to, uint32_t value) { put16(to, value), put16(to + 2, value >> 16); }
static inline uint16_t get16(const uint8_t *from) { return (uint16_t)(from[0] | (uint16_t)from[1] << 8); }
static inline uint32_t get32(const uint8_t *from) { return get16(from) | (uint32_t)get16(from + 2) << 16; }

/* Prepare the table of the CRC, before all other functions. */
void frame_begin(void);

/* Return the CRC-32 (zlib) of the bytes before and `size` more bytes; 0 is the CRC of no bytes. */
uint32_t crc32_more(uint32_t crc, const uint8_t *bytes, uint32_t size);

/* Write a packet as a frame and return the frame's size. `packet` has room for 4 bytes more: the CRC is appended there.
   `frame` has room for size + 4 + (size + 4) / 254 + 2 bytes. */
uint32_t frame_encode(uint8_t *packet, uint32_t size, uint8_t *frame);

/* Decoder, byte by byte. The CRC is computed on the way, so that a long frame of an unknown type needs no memory. */
struct frame_decoder {
    uint8_t packet[LONGEST_COMMAND]; /* first bytes of the packet */
    uint16_t size;                   /* bytes of the packet so far, with its CRC */
    uint16_t received;               /* bytes of the frame so far */
    uint8_t block, left;             /* code of the current COBS block, and its bytes to come */
    uint32_t crc;
    uint32_t frames, damaged, unknown, lost; /* statistics, as those of the host's FrameDecoder */
    uint16_t next;                           /* expected sequence number */
    bool any;                                /* whether a frame has arrived */
};

/* Take a byte. Return the size of the payload if it completes a valid packet of version 1, else -1. The packet's type
   is then at packet[1], its sequence number at packet[2], its payload at packet[4] (the first bytes, if it is long). */
int frame_decode(struct frame_decoder *d, uint8_t byte);

#endif
