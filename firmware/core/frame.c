#include "frame.h"

#define CRC_OF_VALID 0x2144DF1Cu /* CRC-32 of any bytes followed by their CRC-32 */

static uint32_t crc_table[256]; /* in RAM: four bits at a time took an AVR longer than a byte takes on the line */

void frame_begin(void) {
    uint32_t crc = 1;
    for (uint16_t bit = 128; bit; bit >>= 1) { /* the CRC of two bits is that of one, and that of the other */
        crc = crc & 1u ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
        for (uint16_t others = 0; others < 256u; others = (uint16_t)(others + 2u * bit)) crc_table[bit + others] = crc ^ crc_table[others];
    }
}

static uint32_t crc_byte(uint32_t crc, uint8_t byte) { return crc_table[(uint8_t)crc ^ byte] ^ crc >> 8; }

uint32_t crc32_more(uint32_t crc, const uint8_t *bytes, uint32_t size) {
    crc = ~crc;
    while (size--) crc = crc_byte(crc, *bytes++);
    return ~crc;
}

uint32_t frame_encode(uint8_t *packet, uint32_t size, uint8_t *frame) {
    put32(packet + size, crc32_more(0, packet, size));
    size += CRC_BYTES;
    uint32_t code = 0, to = 1; /* positions of the block's code and of the next byte */
    for (uint32_t k = 0; k < size; k++) {
        if (packet[k] == 0) {
            frame[code] = (uint8_t)(to - code);
            code = to++;
            continue;
        }
        frame[to++] = packet[k];
        if (to - code == 255u && k + 1u < size) { /* a full block, after which no zero is implied */
            frame[code] = 255u;
            code = to++;
        }
    }
    frame[code] = (uint8_t)(to - code);
    frame[to++] = 0;
    return to;
}

static void begin(struct frame_decoder *d) {
    d->size = d->received = 0;
    d->block = d->left = 0;
    d->crc = ~(uint32_t)0; /* ~0u has 16 bits on an AVR */
}

static void keep(struct frame_decoder *d, uint8_t byte) {
    if (d->size < LONGEST_COMMAND) d->packet[d->size] = byte;
    d->size++;
    d->crc = crc_byte(d->crc, byte);
}

static int end(struct frame_decoder *d) {
    uint16_t received = d->received, size = d->size;
    bool whole = received < LONGEST_FRAME && d->left == 0 && ~d->crc == CRC_OF_VALID
        && size >= HEADER_BYTES + CRC_BYTES;
    begin(d);
    if (received == 0) return -1; /* two zeros in a row enclose no frame */
    if (!whole) {
        d->damaged++;
        return -1;
    }
    uint16_t sequence = get16(d->packet + 2), gap = d->any ? (uint16_t)(sequence - d->next) : 0;
    if (gap < 1u << 15) d->lost += gap;
    d->any = true;
    d->next = (uint16_t)(sequence + 1u);
    if (d->packet[0] != PROTOCOL_VERSION) {
        d->unknown++;
        return -1;
    }
    d->frames++;
    return (int)(size - HEADER_BYTES - CRC_BYTES);
}

int frame_decode(struct frame_decoder *d, uint8_t byte) {
    if (d->received == 0) begin(d);
    if (byte == 0) return end(d);
    if (d->received >= LONGEST_FRAME) return -1; /* garbage until the next zero */
    d->received++;
    if (d->left == 0) {
        if (d->block != 0 && d->block != 255u) keep(d, 0); /* the zero between two blocks */
        d->block = byte;
        d->left = (uint8_t)(byte - 1u);
    } else {
        d->left--;
        keep(d, byte);
    }
    return -1;
}
