/* Saved settings in the last two sectors of 2 MB of flash. The program runs from RAM, so that it goes on while the flash is
   erased and written; from flash_begin() on nothing can be read as memory there. */
#ifndef FLASH_H
#define FLASH_H

#include <stdbool.h>
#include <stdint.h>

#include "store.h"

/* Take the flash's controller from the boot stage. */
void flash_begin(void);

void flash_read(uint8_t slot, uint8_t *record);

/* Erase a slot, write its record, and read it back: a step for each call. Returns true when it is done, and sets whether
   it reads as it should. */
bool flash_write(uint8_t slot, const uint8_t *record, bool *good);

#endif
