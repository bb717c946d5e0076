/* Fuzzes the decoder and the commands: frames that are valid, damaged or random, and their mixtures. Built with the
   address and undefined-behaviour sanitizers. Arguments: number of frames, seed. */
#include <stdio.h>
#include <stdlib.h>

#include "controller.h"

static uint64_t state;
static uint32_t draw(void) { /* xorshift */
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return (uint32_t)(state >> 32);
}

int main(int argc, char **argv) {
    unsigned long frames = argc > 1 ? strtoul(argv[1], 0, 10) : 100000;
    state = argc > 2 ? strtoull(argv[2], 0, 10) * 2654435761u + 1 : 88172645463325252u;
    static const uint8_t types[] = {SET_SPEED_TYPE, STOP_TYPE, SET_COUNTS_TYPE, PING_TYPE, SAMPLES_TYPE, 0x7F, 0xFF, ASK_TYPE,
        SET_SETTING_TYPE, SAVE_SETTINGS_TYPE, RESTORE_SETTINGS_TYPE};
    static const uint8_t sizes[] = {SET_SPEED_BYTES, STOP_BYTES, SET_COUNTS_BYTES, PING_BYTES, 8, 3, 200, ASK_BYTES,
        SET_SETTING_BYTES, SAVE_SETTINGS_BYTES, RESTORE_SETTINGS_BYTES};
    enum { TYPES = sizeof types };
    uint8_t slots[STORE_SLOTS][STORE_BYTES] = {{0}};
    struct controller *c = malloc(sizeof *c); /* on the heap, where the sanitizer guards its ends */
    if (!c) return 1;
    controller_begin(c, &default_settings, 0);
    uint32_t now = 0, valid = 0, sent = 0;
    for (unsigned long k = 0; k < frames; k++) {
        uint8_t packet[600], frame[700];
        uint32_t which = draw() % (TYPES + 1), size = 0;
        if (which < TYPES) {
            uint32_t payload = draw() % 16 ? sizes[which] : draw() % 400;
            packet[0] = draw() % 32 ? PROTOCOL_VERSION : (uint8_t)draw(), packet[1] = types[which];
            for (uint32_t i = 2; i < 4 + payload; i++) packet[i] = draw() % 4 ? (uint8_t)draw() : 0;
            if (draw() % 2) packet[4] = (uint8_t)(draw() % 16); /* a key, or a type that is asked for */
            if (draw() % 4 == 0) put32(packet + 5, draw() % 4096);
            size = frame_encode(packet, 4 + payload, frame);
        } else {
            size = draw() % sizeof frame;
            for (uint32_t i = 0; i < size; i++) frame[i] = (uint8_t)draw();
        }
        uint32_t damage = draw() % 8, at = size ? draw() % size : 0;
        bool whole = which < TYPES && size <= LONGEST_FRAME && packet[0] == PROTOCOL_VERSION;
        if (damage == 0 && size) frame[at] ^= (uint8_t)(1u << draw() % 8), whole = false;
        else if (damage == 1) size = at, whole = false;
        uint32_t before = c->decoder.frames;
        if (whole) frame_decode(&c->decoder, 0); /* close what came before */
        before = c->decoder.frames;
        for (uint32_t i = 0; i < size; i++) {
            on_byte(c, frame[i]);
            if (i % 64 == 63) controller_poll(c, now);
        }
        controller_poll(c, now);
        if (whole && c->decoder.frames != before + 1) return fprintf(stderr, "frame %lu was not accepted\n", k), 1;
        valid += whole;
        now += 500;
        if (k % 2) on_tick(c, now, (int32_t)draw() >> draw() % 32);
        if (k % 64 == 0 && is_index(c, now, c->count, draw() % 2)) on_index(c, now, c->count);
        c->supply_mv = draw() % 4 ? (uint16_t)draw() : UNKNOWN_MV;
        if (c->saving && draw() % 8 == 0) { /* some bytes of the record are not written */
            for (uint32_t i = 0; i < STORE_BYTES; i++) if (draw() % 64) slots[c->slot][i] = c->record[i];
            controller_saved(c, draw() % 2, now);
        }
        while (controller_take(c) >= 0) sent++;
        if (c->duty > FULL_DUTY || c->duty < -FULL_DUTY || c->batched > BATCH) return fprintf(stderr, "state\n"), 1;
        if (draw() % 4096 == 0) {
            controller_begin(c, &default_settings, now);
            controller_load(c, slots[0], slots[1]);
        }
    }
    printf("%lu frames, %lu valid, %lu bytes sent\n", frames, (unsigned long)valid, (unsigned long)sent);
    free(c);
    return 0;
}
