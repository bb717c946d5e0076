/* ATmega2560 at 14.7456 MHz (a crystal that gives 460,800 baud): the same core on an 8-bit processor. Built, not run.

   A on INT4 (PE4) and B on INT5 (PE5), index on INT3 (PD3), driver: PWM on OC3A (PE3), direction PA0, enable PA1, fault
   PA2, pulse to the camera PA3. Timer 1 counts 1.8432 MHz up to one millisecond. At most about 10,000 edges per second. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "controller.h"

#define PER_TICK 1843u /* 14745600 / 8 / 1000 */

static struct controller c;
static volatile uint32_t tick_us; /* time of the last tick */

static uint32_t now(void) { /* with interrupts disabled */
    uint16_t timer = TCNT1;
    uint32_t passed = TIFR1 & (1 << OCF1A) && timer < PER_TICK / 2 ? 1000 : 0;
    return tick_us + passed + (uint32_t)timer * 1000u / PER_TICK;
}

static uint8_t levels(void) { return (uint8_t)((PINE >> 3 & 2) | (PINE >> 5 & 1)); }

ISR(INT4_vect) { on_edge(&c, levels()); }
ISR(INT5_vect) { on_edge(&c, levels()); }
ISR(INT3_vect) {
    uint32_t t = now();
    on_index(&c, t, PIND & 1 << 3);
}
ISR(USART0_RX_vect) { on_byte(&c, UDR0); }
ISR(TIMER1_COMPA_vect) {
    tick_us += 1000;
    PORTA &= (uint8_t)~(1 << 3);
    uint32_t t = now();
    if (on_tick(&c, t, c.count)) {
        PORTA |= 1 << 3;
        on_sync(&c, now());
    }
}

static uint32_t time(void) {
    cli();
    uint32_t t = now();
    sei();
    return t;
}

int main(void) {
    DDRE = 1 << 3, PORTE = 1 << 4 | 1 << 5;
    DDRA = 1 << 0 | 1 << 1 | 1 << 3, PORTA = 1 << 2;
    UCSR0A = 1 << U2X0, UBRR0 = 3, UCSR0B = 1 << RXCIE0 | 1 << RXEN0 | 1 << TXEN0, UCSR0C = 3 << UCSZ00;
    OCR1A = PER_TICK - 1, TCCR1B = 1 << WGM12 | 1 << CS11, TIMSK1 = 1 << OCIE1A;
    ICR3 = 589, TCCR3A = 1 << COM3A1 | 1 << WGM31, TCCR3B = 1 << WGM33 | 1 << WGM32 | 1 << CS30; /* 25 kHz */
    EICRA = 1 << ISC30, EICRB = 1 << ISC40 | 1 << ISC50, EIMSK = 1 << 3 | 1 << 4 | 1 << 5; /* both edges */
    controller_begin(&c, &default_settings, 0);
    c.settings.counts_per_turn = 400; /* an encoder of 100 lines */
    c.levels = levels();
    tracker_begin(&c.tracker, 0, 400);
    wdt_enable(WDTO_120MS);
    sei();
    for (uint8_t ticks = 0;;) {
        c.driver_fault = !(PINA & 1 << 2);
        controller_poll(&c, time());
        OCR3A = (uint16_t)((c.enabled ? (uint32_t)(c.duty < 0 ? -c.duty : c.duty) : 0) * 589u / FULL_DUTY);
        cli(); /* the tick writes this port too */
        PORTA = (uint8_t)((PORTA & ~3) | (c.duty >= 0 ? 1 : 0) | (c.enabled ? 2 : 0));
        sei();
        for (int byte; UCSR0A & 1 << UDRE0 && (byte = controller_take(&c)) >= 0;) UDR0 = (uint8_t)byte;
        if ((uint8_t)c.ticks != ticks) {
            ticks = (uint8_t)c.ticks;
            wdt_reset();
        }
    }
}
