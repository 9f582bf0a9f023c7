// Plays a gait of softfin on a hobby servo. gait_table.py writes gaits.h. Not tested on hardware.
// Send the number of a row to play it. Any other line stops: the servo returns to its centre, and
// is switched off after a second. While a gait plays, a new row continues at the same phase.

#include <Servo.h>
#include "gaits.h"

const int SERVO_PIN = 9;
const unsigned long CENTRING_MS = 1000;

Servo servo;
long row = 0;  // 0: stopped
int action = 0;
unsigned long last_ms = 0;  // start of the action, or of the stop

void turn(int decidegrees) {
  servo.writeMicroseconds(map(decidegrees, 0, 1800, 544, 2400));  // as Servo.write, but finer
}

void play(int next_action) {
  action = next_action;
  turn((int)pgm_read_word(&DECIDEGREES[row - 1][action]));
}

void command(long new_row) {
  bool stopped = row == 0;
  row = new_row >= 1 && new_row <= ROWS ? new_row : 0;
  if (row && !stopped) return;  // the next action is of the new row
  last_ms = millis();
  if (row) {
    servo.attach(SERVO_PIN);
    play(0);
  } else if (servo.attached()) {
    turn(CENTRE_DECIDEGREES);
  }
}

void setup() {
  Serial.begin(115200);
  Serial.setTimeout(20);  // [ms]; a line without an end does not delay the gait
}

void loop() {
  if (Serial.available()) command(Serial.readStringUntil('\n').toInt());
  unsigned long waited_ms = millis() - last_ms;
  if (row && waited_ms >= MILLIS[action]) {
    last_ms += MILLIS[action];  // without drift
    play((action + 1) % ACTIONS);
  } else if (!row && waited_ms >= CENTRING_MS && servo.attached()) {
    servo.detach();
  }
}
