#include "usb.h"

#include "controller.h"
#include "registers.h"

#define RESETS 0x4000C000u
#define RESETS_DONE 0x4000C008u
#define CLK_USB 0x40008054u
#define MEMORY 0x50100000u   /* of packets: 4 KB */
#define MEMORY_BYTES 0x1000u
#define IN_CONTROL(n) (MEMORY + 8u * (n)) /* of an endpoint from 1 on */
#define OUT_CONTROL(n) (IN_CONTROL(n) + 4u)
#define IN_BUFFER(n) (MEMORY + 0x80u + 8u * (n))
#define OUT_BUFFER(n) (IN_BUFFER(n) + 4u)
#define EP0_DATA 0x100u      /* offsets of the packets in the memory */
#define NOTES_DATA 0x180u
#define OUT_DATA 0x1C0u
#define IN_DATA 0x200u
#define USB 0x50110000u
#define ADDRESS USB
#define MAIN_CONTROL (USB + 0x40u)
#define SIE_CONTROL (USB + 0x4Cu)
#define SIE_STATUS (USB + 0x50u)
#define BUFFER_STATUS (USB + 0x58u)
#define STALL_ARM (USB + 0x68u)
#define MUXING (USB + 0x74u)
#define POWER (USB + 0x78u)
#define BUS_RESET BIT(19)
#define SETUP_RECEIVED BIT(17)
#define EP0_IN_DONE BIT(0)
#define EP0_OUT_DONE BIT(1)
#define IN_DONE BIT(4)
#define OUT_DONE BIT(5)
#define FULL BIT(15)
#define DATA1 BIT(13)
#define STALL BIT(11)
#define AVAILABLE BIT(10)
#define LENGTH 0x3FFu
#define ENABLED BIT(31)
#define EACH_PACKET BIT(29)  /* is reported */
#define BULK (2u << 26)
#define INTERRUPT (3u << 26)

enum { NOTES = 1, DATA = 2 }; /* endpoints: notifications, of which none is sent, and the serial data */
enum { GET_STATUS = 0, CLEAR_FEATURE = 1, SET_ADDRESS = 5, GET_DESCRIPTOR = 6, GET_CONFIGURATION = 8, SET_CONFIGURATION = 9, SET_INTERFACE = 11 };
enum { SET_LINE_CODING = 0x20, GET_LINE_CODING = 0x21, SET_CONTROL_LINE_STATE = 0x22, SEND_BREAK = 0x23 };
enum { DEVICE = 1, CONFIGURATION = 2, STRING = 3 };

/* 1209:0001 is for tests, by pid.codes: whoever gives devices away needs an id of their own. */
static const uint8_t device[18] = {
    18, DEVICE, 0x00, 0x02, 0xEF, 2, 1, USB_PACKET, 0x09, 0x12, 0x01, 0x00, FIRMWARE_MINOR << 4 | FIRMWARE_PATCH, FIRMWARE_MAJOR, 1, 2, 0, 1,
};
#define CONFIGURATION_BYTES 75
static const uint8_t configuration[CONFIGURATION_BYTES] = {
    9, CONFIGURATION, CONFIGURATION_BYTES, 0, 2, 1, 0, 0x80, 250, /* two interfaces, supplied by USB, 500 mA */
    8, 11, 0, 2, 2, 2, 0, 0,                              /* both are one function: CDC ACM */
    9, 4, 0, 0, 1, 2, 2, 0, 0,                            /* interface 0: communication */
    5, 0x24, 0, 0x10, 0x01,                               /* CDC 1.10 */
    5, 0x24, 1, 0, 1,                                     /* no calls */
    4, 0x24, 2, 2,                                        /* line coding and line state */
    5, 0x24, 6, 0, 1,                                     /* interface 1 belongs to 0 */
    7, 5, 0x80 | NOTES, 3, 8, 0, 255,
    9, 4, 1, 0, 2, 10, 0, 0, 0,                           /* interface 1: data */
    7, 5, DATA, 2, USB_PACKET, 0, 0,
    7, 5, 0x80 | DATA, 2, USB_PACKET, 0, 0,
};
static const char *const strings[] = {"amiwarp", "prism controller"};

static uint8_t packet[USB_PACKET]; /* what is sent on endpoint 0, if it is no constant */
static const uint8_t *reply;
static uint16_t reply_left;
static bool replying, reply_ends_empty, expects_coding;
static uint32_t reply_pid;
static uint8_t new_address, chosen; /* address to take after its request; configuration */
static uint8_t coding[7] = {0x00, 0x08, 0x07, 0x00, 0, 0, 8}; /* 460,800 baud, 8N1: it has no effect */
static bool terminal_ready;         /* DTR */
static bool in_busy, out_armed;
static uint32_t in_pid, out_pid;
static uint8_t waiting[256];
static uint16_t waits;

/* The last bit must come some cycles of the USB's clock after the others. */
static void arm(uint32_t buffer, uint32_t value) {
    REG(buffer) = value;
    for (uint32_t k = 0; k < 6; k++) __asm__ volatile("nop\n nop");
    REG(buffer) = value | AVAILABLE;
}

static void copy_in(uint32_t offset, const uint8_t *from, uint32_t size) {
    volatile uint8_t *to = (volatile uint8_t *)(MEMORY + offset);
    for (uint32_t k = 0; k < size; k++) to[k] = from[k];
}

/* Endpoint 0. */

static void send_reply(void) {
    uint16_t size = reply_left < USB_PACKET ? reply_left : USB_PACKET;
    copy_in(EP0_DATA, reply, size);
    reply += size;
    reply_left = (uint16_t)(reply_left - size);
    if (reply_ends_empty && size < USB_PACKET) reply_ends_empty = false;
    arm(IN_BUFFER(0), FULL | reply_pid | size);
    reply_pid ^= DATA1;
}

static void send_nothing(void) { /* the status stage of a request without a reply */
    arm(IN_BUFFER(0), FULL | DATA1);
}

/* Reply with at most as many bytes as the host wants. A reply that is shorter ends with a packet that is not full. */
static void answer(const uint8_t *bytes, uint32_t size, uint32_t wanted) {
    reply = bytes;
    reply_left = (uint16_t)(size < wanted ? size : wanted);
    reply_ends_empty = size < wanted && size % USB_PACKET == 0;
    replying = true;
    send_reply();
}

static void refuse(void) {
    REG(STALL_ARM) = BIT(0) | BIT(1);
    REG(IN_BUFFER(0)) = STALL;
    REG(OUT_BUFFER(0)) = STALL;
}

static void answer_string(uint8_t number, uint32_t wanted) {
    uint8_t size = 2;
    if (number == 0) {
        packet[size++] = 0x09, packet[size++] = 0x04; /* English */
    } else if (number <= sizeof strings / sizeof strings[0]) {
        for (const char *text = strings[number - 1]; *text; text++) packet[size++] = (uint8_t)*text, packet[size++] = 0;
    } else {
        refuse();
        return;
    }
    packet[0] = size, packet[1] = STRING;
    answer(packet, size, wanted);
}

static void configure(uint8_t number) {
    chosen = number;
    terminal_ready = in_busy = out_armed = false;
    in_pid = out_pid = 0;
    waits = 0;
    uint32_t on = number ? ENABLED : 0u;
    REG(IN_BUFFER(DATA)) = REG(OUT_BUFFER(DATA)) = 0u;
    REG(IN_CONTROL(NOTES)) = on | EACH_PACKET | INTERRUPT | NOTES_DATA;
    REG(IN_CONTROL(DATA)) = on | EACH_PACKET | BULK | IN_DATA;
    REG(OUT_CONTROL(DATA)) = on | EACH_PACKET | BULK | OUT_DATA;
}

/* The host has forgotten what it sent last, after an error: the next packet of an endpoint is DATA0. */
static void begin_endpoint(uint16_t endpoint) {
    if (endpoint == (0x80 | DATA)) in_pid = 0;
    if (endpoint != DATA) return;
    REG(OUT_BUFFER(DATA)) = 0u;
    out_pid = 0;
    out_armed = false;
}

static void on_standard(uint8_t type, uint8_t request, uint16_t value, uint16_t index, uint16_t wanted) {
    uint8_t which = (uint8_t)(value >> 8);
    packet[0] = packet[1] = 0;
    if (request == GET_DESCRIPTOR && which == DEVICE) {
        answer(device, sizeof device, wanted);
    } else if (request == GET_DESCRIPTOR && which == CONFIGURATION) {
        answer(configuration, sizeof configuration, wanted);
    } else if (request == GET_DESCRIPTOR && which == STRING) {
        answer_string((uint8_t)value, wanted);
    } else if (request == GET_STATUS) {
        answer(packet, 2, wanted);
    } else if (request == GET_CONFIGURATION) {
        answer(&chosen, 1, wanted);
    } else if (request == SET_ADDRESS && value < 128) {
        new_address = (uint8_t)value;
        send_nothing();
    } else if (request == SET_CONFIGURATION && value <= 1) {
        configure((uint8_t)value);
        send_nothing();
    } else if (request == CLEAR_FEATURE && type == 0x02 && value == 0) {
        begin_endpoint(index);
        send_nothing();
    } else if (request == SET_INTERFACE && value == 0 && chosen) {
        send_nothing();
    } else {
        refuse();
    }
}

static void on_class(uint8_t request, uint16_t value, uint16_t wanted) {
    if (request == SET_LINE_CODING && wanted == sizeof coding) {
        expects_coding = true;
        arm(OUT_BUFFER(0), DATA1 | USB_PACKET);
    } else if (request == GET_LINE_CODING) {
        answer(coding, sizeof coding, wanted);
    } else if (request == SET_CONTROL_LINE_STATE) {
        terminal_ready = value & 1u;
        send_nothing();
    } else if (request == SEND_BREAK) {
        send_nothing();
    } else {
        refuse();
    }
}

static void on_setup(void) {
    uint32_t first = REG(MEMORY), second = REG(MEMORY + 4u);
    uint8_t type = (uint8_t)first, request = (uint8_t)(first >> 8);
    uint16_t value = (uint16_t)(first >> 16), index = (uint16_t)second, wanted = (uint16_t)(second >> 16);
    REG(IN_BUFFER(0)) = REG(OUT_BUFFER(0)) = 0u; /* what was before has ended */
    replying = expects_coding = false;
    new_address = 0;
    reply_pid = DATA1;
    if ((type & 0x60u) == 0) on_standard(type, request, value, index, wanted);
    else if ((type & 0x7Fu) == 0x21u) on_class(request, value, wanted);
    else refuse();
}

static void on_ep0_sent(void) {
    if (new_address) REG(ADDRESS) = new_address;
    new_address = 0;
    if (!replying) return;
    if (reply_left || reply_ends_empty) {
        send_reply();
        return;
    }
    replying = false;
    arm(OUT_BUFFER(0), DATA1 | USB_PACKET); /* the status stage */
}

static void on_ep0_received(void) {
    if (!expects_coding) return;
    expects_coding = false;
    const volatile uint8_t *from = (const volatile uint8_t *)(MEMORY + EP0_DATA);
    for (uint32_t k = 0; k < sizeof coding; k++) coding[k] = from[k];
    send_nothing();
}

static void on_bus_reset(void) {
    REG(ADDRESS) = 0u;
    REG(BUFFER_STATUS) = REG(BUFFER_STATUS);
    REG(IN_BUFFER(0)) = REG(OUT_BUFFER(0)) = 0u;
    replying = expects_coding = false;
    new_address = 0;
    configure(0);
}

/* Serial data. */

static void receive(void) {
    uint32_t size = REG(OUT_BUFFER(DATA)) & LENGTH;
    const volatile uint8_t *from = (const volatile uint8_t *)(MEMORY + OUT_DATA);
    for (uint32_t k = 0; k < size; k++) on_usb_byte(from[k]);
    out_pid ^= DATA1;
    out_armed = false;
}

/* A packet that is not full, so that the host passes it on at once. */
static void transmit(void) {
    uint16_t size = waits < USB_PACKET - 1u ? waits : (uint16_t)(USB_PACKET - 1u);
    copy_in(IN_DATA, waiting, size);
    for (uint16_t k = size; k < waits; k++) waiting[k - size] = waiting[k];
    waits = (uint16_t)(waits - size);
    in_busy = true;
    arm(IN_BUFFER(DATA), FULL | in_pid | size);
    in_pid ^= DATA1;
}

void usb_begin(void) {
    REG(CLK_USB) = BIT(11); /* 48 MHz of the PLL for USB */
    REG(RESETS + 0x3000u) = BIT(24);
    while (!(REG(RESETS_DONE) & BIT(24))) { }
    for (uint32_t k = 0; k < MEMORY_BYTES; k += 4u) REG(MEMORY + k) = 0u;
    REG(MUXING) = BIT(3) | BIT(0);
    REG(POWER) = BIT(3) | BIT(2); /* it is there: the board lives on it */
    REG(MAIN_CONTROL) = 1u;
    REG(SIE_CONTROL) = BIT(29);
    configure(0);
    REG(SIE_CONTROL) = BIT(29) | BIT(16); /* the pull-up shows the device to the host */
}

void usb_poll(uint32_t room) {
    if (REG(SIE_STATUS) & BUS_RESET) {
        REG(SIE_STATUS) = BUS_RESET;
        on_bus_reset();
    }
    uint32_t done = REG(BUFFER_STATUS);
    REG(BUFFER_STATUS) = done;
    if (done & EP0_IN_DONE) on_ep0_sent();
    if (done & EP0_OUT_DONE) on_ep0_received();
    if (REG(SIE_STATUS) & SETUP_RECEIVED) { /* after the end of the request before */
        REG(SIE_STATUS) = SETUP_RECEIVED;
        on_setup();
    }
    if (!chosen) return;
    if (done & IN_DONE) in_busy = false;
    if (done & OUT_DONE) receive();
    if (!out_armed && room >= USB_PACKET) {
        out_armed = true;
        arm(OUT_BUFFER(DATA), out_pid | USB_PACKET);
    }
    if (!in_busy && waits) transmit();
}

bool usb_is_open(void) { return chosen && terminal_ready; }
bool usb_has_room(void) { return waits < sizeof waiting; }
void usb_put(uint8_t byte) { if (usb_has_room()) waiting[waits++] = byte; }
