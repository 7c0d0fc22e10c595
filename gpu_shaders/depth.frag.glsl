// SPDX-License-Identifier: GPL-3.0-or-later
// Written nowhere: the colour mask is off.
void main()
{
  fragment_colour = vec4(0.0);
}
