/* RP2040, without the vendor's libraries. Registers are those of the RP2040 data sheet. Runs from RAM at 125 MHz. */
#include "../pins.h"
#include "controller.h"
#include "flash.h"
#include "registers.h"
#include "usb.h"

#ifndef ENCODER
#define ENCODER QUADRATURE /* or MAGNETIC */
#endif
#ifndef PULSES
#define PULSES PULSES_TIMED /* or PULSES_INDEX, PULSES_CAMERA */
#endif

_Static_assert(ENCODER == QUADRATURE || COUNTS == AS5047_COUNTS, "the magnetic encoder has 16384 counts per turn");

#define PSM_WDSEL 0x40010008u
#define RESETS 0x4000C000u
#define RESETS_DONE 0x4000C008u
#define CLOCKS 0x40008000u
#define XOSC 0x40024000u
#define PLL_SYS 0x40028000u
#define PLL_USB 0x4002C000u
#define IO_CTRL(n) (0x40014004u + 8u * (n))
#define IO_INTR0 0x400140F0u
#define IO_INTE0 0x40014100u
#define IO_INTS0 0x40014120u
#define PAD(n) (0x4001C004u + 4u * (n))
#define UART0 0x40034000u
#define SPI0 0x4003C000u
#define ADC 0x4004C000u
#define PWM4 0x40050050u
#define TIMER 0x40054000u
#define TIMERAWL (TIMER + 0x28u)
#define WATCHDOG 0x40058000u
#define SIO 0xD0000000u
#define GPIO_IN (SIO + 0x04u)
#define GPIO_SET (SIO + 0x14u)
#define GPIO_CLEAR (SIO + 0x18u)
#define NVIC_ENABLE 0xE000E100u
#define NVIC_PRIORITY(n) (0xE000E400u + 4u * (n)) /* of four interrupts */
#define VTOR 0xE000ED08u

enum { IRQ_TIMER_0 = 0, IRQ_IO = 13, IRQ_UART0 = 20, FUNCTION_SPI = 1, FUNCTION_UART = 2, FUNCTION_PWM = 4, FUNCTION_SIO = 5, FUNCTION_NONE = 31 };
enum { PULL_DOWN = 0x46, PULL_UP = 0x4A, OUTPUT = 0x52 }; /* pads: input enable, pulls, Schmitt trigger, 4 mA */
enum { ANALOG = 0x80, ANALOG_PULL_UP = 0x88 };            /* neither input nor output */
#define EDGE_LOW(pin) BIT(4 * (pin) + 2)
#define EDGE_HIGH(pin) BIT(4 * (pin) + 3)
#define PWM_PERIOD 5000 /* 125 MHz / 25 kHz */
#define FULL_SCALE_MV (3300u * (DIVIDER_UPPER + DIVIDER_LOWER) / DIVIDER_LOWER) /* of the supply, at the ADC's 3.3 V */
#define OPEN_ADC 4000u /* of 4095, with the pull-up: nothing else pulls at the pin */
#define WATCHDOG_TICKS 200000u /* 100 ms: it counts twice per microsecond */

static struct controller c;
static uint32_t next_tick;

/* The link is the UART or USB, whichever brings the first valid frame; the other one is not heard until the next reset. */
static volatile enum { LINK_UNKNOWN, LINK_UART, LINK_USB } chosen_link, latest_link;

/* Interrupts. Edges have the highest priority, so that their times are exact; the tick comes next. */

void io_interrupt(void) {
    uint32_t t = REG(TIMERAWL), pending = REG(IO_INTS0), in = REG(GPIO_IN);
    REG(IO_INTR0) = pending;
    if (ENCODER == QUADRATURE) on_edge(&c, (uint8_t)((in >> (PIN_A - 1) & 2u) | (in >> PIN_B & 1u)));
    if (pending & (EDGE_LOW(PIN_INDEX) | EDGE_HIGH(PIN_INDEX))) {
        bool rising = pending & EDGE_HIGH(PIN_INDEX);
        if (!has_absolute_angle(&c.settings) && is_index(&c, t, c.count, rising)) {
            if (PULSES == PULSES_INDEX) {
                REG(GPIO_SET) = BIT(PIN_TRIGGER);
                pulse_begins(&c);
                on_sync(&c, t);
            }
            on_index(&c, t, c.count);
        }
    }
    if (pending & EDGE_HIGH(PIN_CAMERA_SYNC)) on_sync(&c, t);
}

/* The AS5047 needs 350 ns from its selection to the first clock, and between two frames: 48 cycles are 384 ns. */
static inline void wait_for_encoder(void) {
    uint32_t turns = 16;
    __asm__ volatile(".syntax unified\n1: subs %0, #1\n bne 1b" : "+l"(turns) : : "cc");
}

static uint16_t transfer(uint16_t word) { /* 16 bits with the encoder selected: 3 us */
    REG(GPIO_CLEAR) = BIT(PIN_SPI_CS);
    wait_for_encoder();
    REG(SPI0 + 0x08u) = word;
    while (!(REG(SPI0 + 0x0Cu) & 4u)) { }
    uint16_t answer = (uint16_t)REG(SPI0 + 0x08u);
    REG(GPIO_SET) = BIT(PIN_SPI_CS);
    wait_for_encoder();
    return answer;
}

void tick_interrupt(void) {
    REG(TIMER + 0x34u) = 1u;
    next_tick += 1000000u / TICK_HZ;
    REG(TIMER + 0x10u) = next_tick;
    __asm__ volatile("cpsid i" ::: "memory"); /* time and count of one moment */
    if (pulse_ends(&c)) REG(GPIO_CLEAR) = BIT(PIN_TRIGGER);
    uint32_t t = REG(TIMERAWL);
    int32_t count = c.count;
    __asm__ volatile("cpsie i" ::: "memory");
    if (ENCODER == MAGNETIC) {
        ask_encoder(&c, transfer);
        t = REG(TIMERAWL);
        read_encoder(&c, transfer);
        count = c.count;
    }
    if (on_tick(&c, t, count)) {
        __asm__ volatile("cpsid i" ::: "memory");
        REG(GPIO_SET) = BIT(PIN_TRIGGER);
        t = REG(TIMERAWL);
        pulse_begins(&c);
        __asm__ volatile("cpsie i" ::: "memory");
        on_sync(&c, t);
    }
}

void uart_interrupt(void) {
    bool heard = chosen_link != LINK_USB;
    while (!(REG(UART0 + 0x18u) & 0x10u)) {
        uint8_t byte = (uint8_t)REG(UART0);
        if (heard) on_byte(&c, byte);
    }
    if (heard) latest_link = LINK_UART;
    REG(UART0 + 0x44u) = 0x50u;
}

/* Start. */

static void wait_for(uint32_t address, uint32_t bits) {
    while ((REG(address) & bits) != bits) { }
}

/* A clock of 12 MHz * factor / first / second. Returns when it runs. */
static void start_pll(uint32_t pll, uint32_t reset_bit, uint32_t factor, uint32_t first, uint32_t second) {
    SET(RESETS) = BIT(reset_bit);
    CLEAR(RESETS) = BIT(reset_bit);
    wait_for(RESETS_DONE, BIT(reset_bit));
    REG(pll) = 1u;
    REG(pll + 0x08u) = factor;
    CLEAR(pll + 0x04u) = BIT(0) | BIT(5);
    wait_for(pll, BIT(31));
    REG(pll + 0x0Cu) = first << 16 | second << 12;
    CLEAR(pll + 0x04u) = BIT(3);
}

static void start_clocks(void) {
    REG(XOSC + 0x0Cu) = 47u; /* 1 ms */
    REG(XOSC) = 0xFABAA0u;
    wait_for(XOSC + 0x04u, BIT(31));
    REG(CLOCKS + 0x30u) = 2u; /* reference: crystal, 12 MHz */
    wait_for(CLOCKS + 0x38u, BIT(2));
    REG(CLOCKS + 0x3Cu) = 0u; /* system: reference, until the PLL is ready */
    wait_for(CLOCKS + 0x44u, BIT(0));
    start_pll(PLL_SYS, 12, 125u, 6u, 2u);
    start_pll(PLL_USB, 13, 100u, 5u, 5u); /* 48 MHz */
    REG(CLOCKS + 0x3Cu) = 1u; /* system: PLL, 125 MHz */
    wait_for(CLOCKS + 0x44u, BIT(1));
    REG(CLOCKS + 0x48u) = BIT(11); /* peripherals: system */
    REG(CLOCKS + 0x60u) = BIT(11); /* ADC: PLL of 48 MHz */
    REG(WATCHDOG + 0x2Cu) = BIT(9) | 12u; /* ticks of 1 us */
}

static void set_pin(uint32_t pin, uint32_t pad, uint32_t function) {
    REG(PAD(pin)) = pad;
    REG(IO_CTRL(pin)) = function;
}

static void start_peripherals(void) {
    uint32_t used = BIT(0) | BIT(5) | BIT(8) | BIT(14) | BIT(16) | BIT(21) | BIT(22); /* ADC, IO, pads, PWM, SPI0, timer, UART0 */
    CLEAR(RESETS) = used;
    wait_for(RESETS_DONE, used);
    REG(SIO + 0x10u) = BIT(PIN_SPI_CS); /* output levels, then directions */
    uint32_t outputs = BIT(PIN_TRIGGER) | BIT(PIN_DIRECTION) | BIT(PIN_ENABLE) | BIT(PIN_SPI_CS) | BIT(PIN_LED);
    REG(SIO + 0x20u) = outputs;
    for (uint32_t pin = 0; pin <= PIN_LED; pin++) if (outputs & BIT(pin)) set_pin(pin, OUTPUT, FUNCTION_SIO);
    set_pin(PIN_A, PULL_UP, FUNCTION_SIO), set_pin(PIN_B, PULL_UP, FUNCTION_SIO);
    set_pin(PIN_INDEX, PULL_DOWN, FUNCTION_SIO), set_pin(PIN_CAMERA_SYNC, PULL_DOWN, FUNCTION_SIO);
    set_pin(PIN_DRIVER_FAULT, PULL_UP, FUNCTION_SIO), set_pin(PIN_SUPPLY, PULL_UP, FUNCTION_SIO);
    set_pin(PIN_UART_TX, OUTPUT, FUNCTION_UART), set_pin(PIN_UART_RX, PULL_UP, FUNCTION_UART);
    set_pin(PIN_SPI_MISO, PULL_UP, FUNCTION_SPI); /* a missing encoder answers 0xFFFF, an error */
    set_pin(PIN_SPI_SCK, OUTPUT, FUNCTION_SPI), set_pin(PIN_SPI_MOSI, OUTPUT, FUNCTION_SPI);
    REG(UART0 + 0x24u) = 16u, REG(UART0 + 0x28u) = 61u; /* 460,800 baud */
    REG(UART0 + 0x2Cu) = 0x70u;                         /* 8N1, FIFOs */
    REG(UART0 + 0x38u) = 0x50u;                         /* interrupts: bytes received, and none for a while */
    REG(UART0 + 0x30u) = 0x301u;
    REG(SPI0 + 0x10u) = 2u;
    REG(SPI0) = 7u << 8 | BIT(7) | 15u; /* 7.8 MHz, phase 1, 16 bits */
    REG(SPI0 + 0x04u) = 2u;
    REG(PWM4 + 0x04u) = 1u << 4;
    REG(PWM4 + 0x10u) = PWM_PERIOD - 1u;
    REG(PWM4 + 0x0Cu) = 0u;
    REG(PWM4) = 1u;
    set_pin(PIN_PWM, OUTPUT, FUNCTION_PWM);
}

static void drive(void) {
    uint32_t size = (uint32_t)(c.duty < 0 ? -c.duty : c.duty);
    REG(c.duty < 0 ? GPIO_CLEAR : GPIO_SET) = BIT(PIN_DIRECTION);
    REG(PWM4 + 0x0Cu) = c.enabled ? size * PWM_PERIOD / FULL_DUTY : 0u;
    REG(c.enabled ? GPIO_SET : GPIO_CLEAR) = BIT(PIN_ENABLE) | BIT(PIN_LED);
}

/* The supply's voltage. Whether its divider is connected is found at the start: an open pin follows its pull-up. */

static bool supply_is_sensed;

static uint32_t convert(void) {
    SET(ADC) = BIT(2);
    wait_for(ADC, BIT(8));
    return REG(ADC + 0x04u);
}

static void begin_supply(void) {
    REG(ADC) = BIT(0); /* channel 0, GPIO 26 */
    wait_for(ADC, BIT(8));
    set_pin(PIN_SUPPLY_ADC, ANALOG_PULL_UP, FUNCTION_NONE);
    uint32_t start = REG(TIMERAWL);
    while (REG(TIMERAWL) - start < 1000u) { } /* for the capacitance of a wire */
    supply_is_sensed = convert() < OPEN_ADC;
    set_pin(PIN_SUPPLY_ADC, ANALOG, FUNCTION_NONE);
    SET(ADC) = BIT(2);
}

static void read_supply(void) {
    if (!supply_is_sensed || !(REG(ADC) & BIT(8))) return;
    c.supply_mv = (uint16_t)(REG(ADC + 0x04u) * FULL_SCALE_MV >> 12);
    SET(ADC) = BIT(2);
}

static void load(void) {
    static uint8_t slots[STORE_SLOTS][STORE_BYTES];
    flash_begin();
    for (uint8_t slot = 0; slot < STORE_SLOTS; slot++) flash_read(slot, slots[slot]);
    controller_load(&c, slots[0], slots[1]);
}

static void save(void) {
    bool good = false;
    if (c.saving && flash_write(c.slot, c.record, &good)) controller_saved(&c, good, REG(TIMERAWL));
}

void on_usb_byte(uint8_t byte) {
    if (chosen_link == LINK_UART) return;
    __asm__ volatile("cpsid i" ::: "memory"); /* the UART's interrupt writes to the same ring, until the link is chosen */
    latest_link = LINK_USB;
    on_byte(&c, byte);
    __asm__ volatile("cpsie i" ::: "memory");
}

/* Send what waits; until the link is chosen to both, so that a host on either one hears the controller. Returns whether
   bytes are left. */
static bool send_waiting(void) {
    bool open = usb_is_open();
    for (;;) {
        bool fits = chosen_link == LINK_USB ? !open || usb_has_room() : !(REG(UART0 + 0x18u) & 0x20u);
        if (!fits) return true;
        int byte = controller_take(&c);
        if (byte < 0) return false;
        if (chosen_link != LINK_USB) REG(UART0) = (uint32_t)byte;
        if (chosen_link != LINK_UART && open) usb_put((uint8_t)byte);
    }
}

int main(void) {
    start_clocks();
    start_peripherals();
    struct settings settings = default_settings;
    settings.encoder = ENCODER, settings.pulses = PULSES;
    controller_begin(&c, &settings, REG(TIMERAWL));
    load();
    begin_supply();
    usb_begin();
    uint32_t in = REG(GPIO_IN), ticks = 0;
    c.levels = (uint8_t)((in >> (PIN_A - 1) & 2u) | (in >> PIN_B & 1u));
    REG(IO_INTE0) = (ENCODER == QUADRATURE ? EDGE_LOW(PIN_A) | EDGE_HIGH(PIN_A) | EDGE_LOW(PIN_B) | EDGE_HIGH(PIN_B) : 0u)
        | EDGE_LOW(PIN_INDEX) | EDGE_HIGH(PIN_INDEX) /* with an absolute angle, too: a setting may change it */
        | (PULSES == PULSES_CAMERA ? EDGE_HIGH(PIN_CAMERA_SYNC) : 0u);
    REG(NVIC_PRIORITY(0)) = 0x40u;         /* timer 0 */
    REG(NVIC_PRIORITY(5)) = 0x80u;         /* UART 0 */
    next_tick = REG(TIMERAWL) + 1000u;
    REG(TIMER + 0x38u) = 1u;
    REG(TIMER + 0x10u) = next_tick;
    REG(NVIC_ENABLE) = BIT(IRQ_TIMER_0) | BIT(IRQ_IO) | BIT(IRQ_UART0);
    REG(PSM_WDSEL) = 0x1FFFCu; /* everything but the oscillators */
    REG(WATCHDOG + 0x04u) = WATCHDOG_TICKS;
    REG(WATCHDOG) = BIT(30);
    for (;;) {
        uint32_t now = REG(GPIO_IN);
        c.driver_fault = !(now & BIT(PIN_DRIVER_FAULT));
        c.supply_low = !(now & BIT(PIN_SUPPLY));
        read_supply();
        usb_poll(RX_BYTES - 1u - WAITING(c.rx)); /* one place stays free */
        controller_poll(&c, REG(TIMERAWL));
        if (chosen_link == LINK_UNKNOWN && c.decoder.frames) chosen_link = latest_link;
        save();
        drive();
        bool left = send_waiting();
        if (c.ticks != ticks) { /* both the timer's interrupt and this loop run */
            ticks = c.ticks;
            REG(WATCHDOG + 0x04u) = WATCHDOG_TICKS;
        }
        while (!left && c.ticks == ticks && c.rx.head == c.rx.tail) __asm__ volatile("wfi"); /* edges wake it, too */
    }
}

/* Vectors, and the start in RAM. The compiler may call memset and memcpy. */

extern uint32_t stack_top, bss_begin, bss_end;

void *memset(void *to, int value, __SIZE_TYPE__ size) {
    for (volatile uint8_t *p = to; size--;) *p++ = (uint8_t)value;
    return to;
}

void *memcpy(void *restrict to, const void *restrict from, __SIZE_TYPE__ size) {
    volatile uint8_t *p = to;
    for (const uint8_t *q = from; size--;) *p++ = *q++;
    return to;
}

static void stop_here(void) { /* a fault of the processor: the motor off, until the watchdog resets */
    REG(GPIO_CLEAR) = BIT(PIN_ENABLE);
    for (;;) { }
}

void reset(void) {
    for (uint32_t *p = &bss_begin; p < &bss_end; p++) *p = 0;
    main();
}

__attribute__((section(".vectors"), used)) static const void *const vectors[48] = {
    [0] = &stack_top, [1] = (void *)reset, [2] = (void *)stop_here, [3] = (void *)stop_here, [11] = (void *)stop_here,
    [14] = (void *)stop_here, [15] = (void *)stop_here, [16 + IRQ_TIMER_0] = (void *)tick_interrupt,
    [16 + IRQ_IO] = (void *)io_interrupt, [16 + IRQ_UART0] = (void *)uart_interrupt,
};

__attribute__((section(".entry"), used, naked)) void entry(void) {
    __asm__ volatile("cpsid i\n ldr r0, =vectors\n ldr r1, =0xE000ED08\n str r0, [r1]\n ldr r1, [r0]\n msr msp, r1\n"
                     "ldr r0, [r0, #4]\n cpsie i\n bx r0\n .ltorg");
}
