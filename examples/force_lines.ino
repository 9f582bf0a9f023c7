// Two load cells on HX711 converters as the force sensor of a rig, for softfin's sensor type "lines".
// Not tested on hardware. From the data sheet of the HX711 (AVIA Semiconductor, "24-Bit ADC for Weigh
// Scales", sections Serial Interface and Reset and Power-Down): a low data line means that a sample is
// ready, 24 bits follow, the most significant first, and 25 clock pulses select channel A with gain 128
// for the next sample. Connect RATE to VCC for 80 samples per second.
// The numbers are raw: rig.yaml contains the scale, and softfin keeps the zero.

const int CLOCK_PIN = 2;
const int DATA_PINS[] = {3, 4};  // force x, force y; both converters share the clock

void setup() {
  Serial.begin(115200);
  pinMode(CLOCK_PIN, OUTPUT);
  digitalWrite(CLOCK_PIN, LOW);
  for (int pin : DATA_PINS) pinMode(pin, INPUT);
}

void loop() {
  if (digitalRead(DATA_PINS[0]) || digitalRead(DATA_PINS[1])) return;  // a sample is not ready
  unsigned long time_us = micros();
  long value[2] = {0, 0};
  noInterrupts();  // a clock pulse longer than 50 us is not allowed; 60 us switch the converters off
  for (int bit = 0; bit < 25; bit++) {
    digitalWrite(CLOCK_PIN, HIGH);
    digitalWrite(CLOCK_PIN, LOW);
    for (int i = 0; bit < 24 && i < 2; i++) value[i] = value[i] << 1 | digitalRead(DATA_PINS[i]);
  }
  interrupts();
  Serial.print(time_us);
  for (long v : value) {
    Serial.print(',');
    Serial.print(v & 0x800000L ? v - 0x1000000L : v);  // sign of 24 bits
  }
  Serial.println();
}
