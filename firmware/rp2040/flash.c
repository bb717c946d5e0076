#include "flash.h"

#include "registers.h"

#define SSI 0x18000000u
#define SSI_ENABLE (SSI + 0x08u)
#define SSI_STATUS (SSI + 0x28u)
#define SSI_DATA (SSI + 0x60u)
#define CHIP_SELECT 0x4001800Cu /* of the flash: pin 1 of the bank IO_QSPI */
#define SELECTED (2u << 8)      /* override: low */
#define RELEASED (3u << 8)      /* override: high */
#define FIRST_SLOT 0x1FE000u
#define SECTOR_BYTES 0x1000u

/* Commands that each serial flash has. */
enum { PROGRAM = 0x02, READ = 0x03, READ_STATUS = 0x05, WRITE_ENABLE = 0x06, ERASE_SECTOR = 0x20 };
enum { BUSY = 1 };

static uint8_t transfer(uint8_t byte) {
    REG(SSI_DATA) = byte;
    while (!(REG(SSI_STATUS) & BIT(3))) { }
    return (uint8_t)REG(SSI_DATA);
}

static void select(uint8_t command) {
    REG(CHIP_SELECT) = SELECTED;
    transfer(command);
}

static void release(void) { REG(CHIP_SELECT) = RELEASED; }

static void send_address(uint8_t slot) {
    uint32_t address = FIRST_SLOT + slot * SECTOR_BYTES;
    transfer((uint8_t)(address >> 16)), transfer((uint8_t)(address >> 8)), transfer((uint8_t)address);
}

static void allow_write(void) {
    select(WRITE_ENABLE);
    release();
}

static bool is_busy(void) {
    select(READ_STATUS);
    uint8_t status = transfer(0);
    release();
    return status & BUSY;
}

void flash_begin(void) {
    REG(SSI_ENABLE) = 0u;
    REG(CHIP_SELECT) = RELEASED;
    REG(SSI) = 7u << 16;      /* 8 bits, sent and received together */
    REG(SSI + 0x10u) = 1u;    /* one flash; its select line is the override */
    REG(SSI_ENABLE) = 1u;
}

void flash_read(uint8_t slot, uint8_t *record) {
    select(READ);
    send_address(slot);
    for (uint32_t k = 0; k < STORE_BYTES; k++) record[k] = transfer(0);
    release();
}

static void erase(uint8_t slot) {
    allow_write();
    select(ERASE_SECTOR);
    send_address(slot);
    release();
}

static void program(uint8_t slot, const uint8_t *record) {
    _Static_assert(STORE_BYTES <= 256u, "a record fits in a page");
    allow_write();
    select(PROGRAM);
    send_address(slot);
    for (uint32_t k = 0; k < STORE_BYTES; k++) transfer(record[k]);
    release();
}

bool flash_write(uint8_t slot, const uint8_t *record, bool *good) {
    static enum { IDLE, ERASING, PROGRAMMING } doing;
    static uint8_t written[STORE_BYTES];
    if (doing == IDLE) {
        erase(slot);
        doing = ERASING;
        return false;
    }
    if (is_busy()) return false;
    if (doing == ERASING) {
        program(slot, record);
        doing = PROGRAMMING;
        return false;
    }
    doing = IDLE;
    flash_read(slot, written);
    *good = true;
    for (uint32_t k = 0; k < STORE_BYTES; k++) *good = *good && written[k] == record[k];
    return true;
}
