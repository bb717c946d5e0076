#include "store.h"

#include "frame.h"

#define LAYOUT 1u
#define RECORD_BUILD 4u
#define RECORD_NUMBER 8u
#define RECORD_VALUES 12u
#define RECORD_CRC (STORE_BYTES - CRC_BYTES)

static uint32_t build_of(const struct settings *s) {
    uint8_t kind[2] = {s->encoder, s->pulses}, value[4];
    uint32_t crc = crc32_more(0, kind, sizeof kind);
    for (uint8_t key = 0; key < SETTINGS; key++) {
        put32(value, (uint32_t)settings_get(s, key));
        crc = crc32_more(crc, value, sizeof value);
    }
    return crc;
}

static bool is_blank(const uint8_t *slot) {
    for (uint16_t k = 0; k < STORE_BYTES; k++) if (slot[k] != 0xFFu) return false;
    return true;
}

/* Whether a slot has a whole record of this layout that belongs there. */
static bool is_whole(const uint8_t *slot, uint8_t place) {
    if (get16(slot) != LAYOUT || get16(slot + 2) != SETTINGS || get32(slot + RECORD_NUMBER) % STORE_SLOTS != place) return false;
    return crc32_more(0, slot, RECORD_CRC) == get32(slot + RECORD_CRC);
}

static bool take(struct settings *s, const uint8_t *slot) {
    struct settings found = *s;
    for (uint8_t key = 0; key < SETTINGS; key++) {
        if (!settings_set(&found, key, (int32_t)get32(slot + RECORD_VALUES + 4u * key))) return false;
    }
    *s = found;
    return true;
}

void store_load(struct store *store, struct settings *s, const uint8_t *slot0, const uint8_t *slot1) {
    const uint8_t *slots[STORE_SLOTS] = {slot0, slot1};
    const uint8_t *newest = 0;
    uint32_t newest_number = 0;
    store->build = build_of(s);
    store->number = 0;
    store->stored = STORED_NONE;
    for (uint8_t place = 0; place < STORE_SLOTS; place++) {
        const uint8_t *slot = slots[place];
        uint32_t number = get32(slot + RECORD_NUMBER);
        if (!is_whole(slot, place)) {
            if (!is_blank(slot) && store->stored == STORED_NONE) store->stored = STORED_DAMAGED;
            continue;
        }
        if (number > store->number) store->number = number;
        if (get32(slot + RECORD_BUILD) != store->build) {
            store->stored = STORED_OTHER_BUILD;
        } else if (!newest || number > newest_number) {
            newest = slot;
            newest_number = number;
        }
    }
    if (newest) store->stored = take(s, newest) ? STORED_SAVED : STORED_DAMAGED;
}

uint8_t store_pack(const struct store *store, const struct settings *s, uint8_t *record) {
    uint32_t number = store->number + 1u;
    put16(record, LAYOUT), put16(record + 2, SETTINGS);
    put32(record + RECORD_BUILD, store->build);
    put32(record + RECORD_NUMBER, number);
    for (uint8_t key = 0; key < SETTINGS; key++) put32(record + RECORD_VALUES + 4u * key, (uint32_t)settings_get(s, key));
    put32(record + RECORD_CRC, crc32_more(0, record, RECORD_CRC));
    return (uint8_t)(number % STORE_SLOTS);
}
