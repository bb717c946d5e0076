/* Saved settings: a record in one of two slots of a memory that outlives a reset, flash or EEPROM. A save writes the slot
   of the older record, so that a power cut in the middle leaves the other one. */
#ifndef STORE_H
#define STORE_H

#include "settings.h"

#define STORE_SLOTS 2u
#define STORE_BYTES (12u + 4u * SETTINGS + 4u) /* layout, number of settings, build, number of the record, settings, CRC */

/* Where the settings are from, as the protocol's Condition says. */
enum stored { STORED_NONE, STORED_SAVED, STORED_OTHER_BUILD, STORED_DAMAGED };

struct store {
    uint32_t number; /* of the newest record, which is in slot number % 2; 0: none */
    uint32_t build;  /* check sum of the build's own settings: saved ones hold for this build alone */
    uint8_t stored;
};

/* Take the settings of the newest record for this build; *s are those of the build, which stay if there is none. */
void store_load(struct store *store, struct settings *s, const uint8_t *slot0, const uint8_t *slot1);

/* Write the record that comes next, and return the slot that it belongs to. */
uint8_t store_pack(const struct store *store, const struct settings *s, uint8_t *record);

#endif
