/* ATmega2560 at 16 MHz (Arduino Mega): the same core on an 8-bit processor.

   Pins (number on an Arduino Mega): A on PE4 (2), B on PE5 (3), both pulled up; index on PL0 (49) and pulses of the camera
   on PL1 (48), which the timers capture; driver: PWM of 27 kHz on PE3 (5), direction PA0 (22), enable PA1 (23), fault PA2
   (24), pulled up; pulse to the camera PA3 (25); supply of the motor, divided, PA4 (26), pulled up; its voltage by the divider of pins.h ADC0 (A0). The link is UART 0 at 500,000 baud: 16 MHz cannot divide to 460,800. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "../pins.h"
#include "controller.h"

#ifndef PULSES
#define PULSES PULSES_TIMED
#endif
#define PER_TICK 2000u /* timers count 2 MHz */
#define PWM_TOP 589u
#define TRIGGER (1 << 3)
#define FULL_SCALE_MV (5000ul * (DIVIDER_UPPER + DIVIDER_LOWER) / DIVIDER_LOWER) /* of the supply; an int has 16 bits */
#define OPEN_ADC 1000u /* of 1023, with the pull-up: nothing else pulls at the pin */
#define SLOT_BYTES 256u /* of the EEPROM */

_Static_assert((uint32_t)COUNTS * RATIO * MOST_RPM / 60 <= MOST_EDGES_PER_S, "75,000 edges per second at most: see MOST_RPM");

static struct controller c;
static volatile uint32_t tick_us; /* time of the last tick */

/* An edge takes half of the time of on_edge(), as its interrupt changes bytes alone: the count modulo 256, the number
   of lost edges and the levels (B, A) are in registers of general purpose. take_edges() adds them to those of the core.
   Table: quadrature_step by the levels before (bits 1 and 0) and now (bits 5 and 4, as in the port). */
#define COUNT GPIOR0
#define LOST GPIOR1
#define LEVELS GPIOR2
#define MOST_EDGES 110 /* per millisecond */
#define AB (1 << 4 | 1 << 5)
static int8_t steps[64];
static volatile int8_t last_step;
static uint8_t seen, seen_lost;

#define INLINE static inline __attribute__((always_inline)) /* a call in an interrupt saves all registers */

/* Time [us] before `ago` counts of the timers; with interrupts disabled. */
INLINE uint32_t time_before(uint16_t ago) {
    uint16_t timer = TCNT1;
    uint32_t passed = TIFR1 & (1 << OCF1A) && timer < PER_TICK / 2 ? 1000 : 0;
    return tick_us + passed + (uint32_t)(int32_t)((int16_t)(timer - ago) >> 1);
}
INLINE uint32_t now(void) { return time_before(0); }

INLINE void take_edges(void) { /* with interrupts disabled; at least once in 127 edges */
    uint8_t count = COUNT, lost = LOST;
    int8_t step = (int8_t)(count - seen);
    c.count = (int32_t)((uint32_t)c.count + (uint32_t)(int32_t)step); /* wraps */
    if (step > MOST_EDGES || step < -MOST_EDGES) c.too_fast = true;
    c.edges_lost += (uint8_t)(lost - seen_lost);
    c.backwards = last_step < 0;
    seen = count, seen_lost = lost;
}

static void begin_edges(void) {
    static const uint8_t levels[4] = {0, 2, 1, 3}; /* B and A exchanged */
    for (uint8_t k = 0; k < 16; k++) steps[(k & 3) << 4 | k >> 2] = quadrature_step[levels[k >> 2] << 2 | levels[k & 3]];
    LEVELS = (PINE & AB) >> 4;
}

static void send_pulse(void) {
    cli();
    PORTA |= TRIGGER;
    uint32_t t = now();
    pulse_begins(&c);
    sei();
    on_sync(&c, t);
}

/* Interrupts. Edges have the highest priority, and the longer ones of index and tick let others interrupt them. */

ISR(INT4_vect) {
    uint8_t now = PINE & AB;
    int8_t step = steps[now | LEVELS];
    LEVELS = now >> 4;
    if (step == QUADRATURE_LOST) { /* late: the next edge has come. Count two in the same direction */
        LOST++;
        COUNT = (uint8_t)(COUNT + 2 * last_step);
    } else {
        COUNT = (uint8_t)(COUNT + step);
        if (step) last_step = step;
    }
}
ISR(INT5_vect, ISR_ALIASOF(INT4_vect));

ISR(TIMER4_CAPT_vect) { /* index: the timer has captured the time of the edge */
    uint16_t captured = ICR4, ago = TCNT4 - captured;
    uint32_t t = time_before(ago);
    bool rising = TCCR4B & 1 << ICES4;
    uint8_t high;
    do { /* next is the other edge, by the level: edges of a sensor that bounces may have been missed */
        high = PINL & 1;
        TCCR4B = (uint8_t)((TCCR4B & ~(1 << ICES4)) | (high ? 0 : 1 << ICES4));
        TIFR4 = 1 << ICF4;
    } while (high != (PINL & 1));
    take_edges();
    int32_t count = c.count;
    TIMSK4 = 0;
    sei();
    if (is_index(&c, t, count, rising)) {
        on_index(&c, t, count);
        if (PULSES == PULSES_INDEX) send_pulse();
    }
    cli();
    TIMSK4 = 1 << ICIE4;
}

ISR(TIMER5_CAPT_vect) { /* pulse of the camera */
    uint16_t captured = ICR5, ago = TCNT5 - captured;
    on_sync(&c, time_before(ago));
}

ISR(USART0_RX_vect) { on_byte(&c, UDR0); }
ISR(USART0_UDRE_vect) {
    int byte = controller_take(&c);
    if (byte < 0) UCSR0B &= (uint8_t)~(1 << UDRIE0);
    else UDR0 = (uint8_t)byte;
}

ISR(TIMER1_COMPA_vect) {
    tick_us += 1000;
    uint32_t t = now();
    take_edges();
    int32_t count = c.count;
    if (pulse_ends(&c)) PORTA &= (uint8_t)~TRIGGER;
    sei();
    if (on_tick(&c, t, count)) send_pulse();
}

static uint32_t time(void) {
    cli();
    uint32_t t = now();
    sei();
    return t;
}

static void drive(void) {
    uint32_t duty = c.enabled ? (uint32_t)(c.duty < 0 ? -c.duty : c.duty) : 0;
    uint16_t compare = (uint16_t)(duty * (PWM_TOP + 1u) >> 15);
    uint8_t pins = (uint8_t)((c.duty >= 0 ? 1 : 0) | (c.enabled ? 2 : 0));
    cli(); /* interrupts write this port, too */
    OCR3A = compare;
    PORTA = (uint8_t)((PORTA & ~3) | pins);
    if (c.tx.head != c.tx.tail) UCSR0B |= 1 << UDRIE0;
    sei();
}

/* The supply's voltage. Whether its divider is connected is found at the start: an open pin follows its pull-up. */

static bool supply_is_sensed;

static uint16_t convert(void) {
    ADCSRA |= 1 << ADSC;
    while (ADCSRA & 1 << ADSC) { }
    return ADC;
}

static void begin_supply(void) {
    DIDR0 = 1;
    ADMUX = 1 << REFS0; /* full scale: the board's 5 V */
    ADCSRA = 1 << ADEN | 1 << ADPS2 | 1 << ADPS1 | 1 << ADPS0; /* 125 kHz */
    PORTF = 1;
    convert();
    supply_is_sensed = convert() < OPEN_ADC;
    PORTF = 0;
    if (!supply_is_sensed) return;
    convert();
    ADCSRA |= 1 << ADSC;
}

static void read_supply(void) {
    if (!supply_is_sensed || ADCSRA & 1 << ADSC) return;
    c.supply_mv = (uint16_t)(ADC * FULL_SCALE_MV >> 10);
    ADCSRA |= 1 << ADSC;
}

/* Saved settings in the EEPROM. */

static uint8_t read_eeprom(uint16_t address) { /* not while a byte is written */
    EEAR = address;
    EECR |= 1 << EERE;
    return EEDR;
}

static void load(void) {
    static uint8_t slots[STORE_SLOTS][STORE_BYTES];
    for (uint8_t slot = 0; slot < STORE_SLOTS; slot++) {
        for (uint16_t k = 0; k < STORE_BYTES; k++) slots[slot][k] = read_eeprom(slot * SLOT_BYTES + k);
    }
    controller_load(&c, slots[0], slots[1]);
}

/* Write the next byte of a record, which takes 3.4 ms, and compare all when they are written. */
static void save(uint32_t t) {
    static uint16_t written;
    if (!c.saving || EECR & 1 << EEPE) return;
    uint16_t first = c.slot * SLOT_BYTES;
    if (written < STORE_BYTES) {
        EEAR = first + written;
        EEDR = c.record[written++];
        cli(); /* the second bit counts within four cycles after the first */
        EECR |= 1 << EEMPE;
        EECR |= 1 << EEPE;
        sei();
        return;
    }
    bool good = true;
    for (uint16_t k = 0; k < STORE_BYTES; k++) good = good && read_eeprom(first + k) == c.record[k];
    written = 0;
    controller_saved(&c, good, t);
}

int main(void) {
    wdt_enable(WDTO_120MS); /* after a reset by the watchdog it runs with its shortest time */
    DDRE = 1 << 3, PORTE = 1 << 4 | 1 << 5;
    DDRA = 1 << 0 | 1 << 1 | TRIGGER, PORTA = 1 << 2 | 1 << 4;
    ICR3 = PWM_TOP, TCCR3A = 1 << COM3A1 | 1 << WGM31, TCCR3B = 1 << WGM33 | 1 << WGM32 | 1 << CS30;
    struct settings settings = default_settings;
    settings.pulses = PULSES;
    controller_begin(&c, &settings, 0); /* takes half a tick */
    load();
    begin_supply();
    begin_edges();
    UCSR0A = 1 << U2X0, UBRR0 = 3, UCSR0B = 1 << RXCIE0 | 1 << RXEN0 | 1 << TXEN0, UCSR0C = 3 << UCSZ00;
    OCR1A = PER_TICK - 1, TCCR1B = 1 << WGM12 | 1 << CS11, TIMSK1 = 1 << OCIE1A;
    TCCR4B = (uint8_t)((PINL & 1 ? 0 : 1 << ICES4) | 1 << CS41), TIMSK4 = 1 << ICIE4;
    TCCR5B = 1 << ICES5 | 1 << CS51, TIMSK5 = PULSES == PULSES_CAMERA ? 1 << ICIE5 : 0;
    EICRB = 1 << ISC40 | 1 << ISC50, EIFR = EIMSK = 1 << 4 | 1 << 5; /* both edges */
    set_sleep_mode(SLEEP_MODE_IDLE);
    sleep_enable();
    sei();
    for (uint8_t ticks = 0;;) {
        c.driver_fault = !(PINA & 1 << 2);
        c.supply_low = !(PINA & 1 << 4);
        read_supply();
        controller_poll(&c, time());
        save(time());
        drive();
        if ((uint8_t)c.ticks != ticks) {
            ticks = (uint8_t)c.ticks;
            wdt_reset();
        }
        for (;;) {
            cli();
            if ((uint8_t)c.ticks != ticks || c.rx.head != c.rx.tail) break;
            sei(); /* takes effect after the next instruction */
            sleep_cpu();
            __asm__ volatile("nop"); /* simavr begins a waiting interrupt only after one more instruction */
        }
        sei();
    }
}
